"""The TLS library of the ESP8266 with the firmware's buffers, and a real broker with certificates of Fognav."""

import re
import subprocess
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from fog_contracts.channels import BROKER_NAME
from fog_runtime.credentials import Credentials
from fog_runtime.security.site_security import AUTHORITY, SiteSecurity
from fog_supervisor.servers import start_mosquitto

BAD_SERVER_NAME = 56
NOT_TRUSTED = 62


@pytest.fixture(scope="module")
def probe(firmware, compiler, tmp_path_factory):
    if not Path("/usr/include/bearssl/bearssl.h").is_file():
        pytest.skip("no bearssl/bearssl.h: apt-get install libbearssl-dev")
    program = tmp_path_factory.mktemp("probe") / "probe"
    source = str(firmware / "host" / "tls" / "probe.cpp")
    subprocess.run(
        [compiler, "-std=c++17", "-Wall", "-Wextra", "-Werror", source, "-lbearssl", "-o", program], check=True
    )
    return program


@pytest.fixture(scope="module")
def security(tmp_path_factory):
    made = SiteSecurity(tmp_path_factory.mktemp("locks"), "lab")
    made.make(["127.0.0.1", "fog.lan"], nodes=["n1"])
    return made


@pytest.fixture(scope="module")
def broker(security, tmp_path_factory):
    with start_mosquitto(tmp_path_factory.mktemp("broker"), security=security.folder("mosquitto")) as server:
        yield server


def hello(user, password):
    """Return MQTT's first packet."""
    texts = ["node-lab-n1", user, password]
    body = b"\x00\x04MQTT\x04\xc2\x00\x3c" + b"".join(len(text).to_bytes(2, "big") + text.encode() for text in texts)
    return bytes([0x10, len(body)]) + body


def answer(probe, firmware, broker, security, name):
    """Return what the library says after connecting with the sizes that the firmware has."""
    text = (firmware / "src" / "broker_transport.cpp").read_text()
    sizes = [re.search(rf"{each} = (\d+);", text)[1] for each in ("kReceiveSize", "kSendSize")]
    authority = x509.load_pem_x509_certificate((security.folder("mosquitto").parent / AUTHORITY).read_bytes())
    point = authority.public_key().public_bytes(Encoding.X962, PublicFormat.UncompressedPoint)
    own = Credentials.read(security.credentials("n1"))
    words = [str(broker.port), name, authority.subject.public_bytes().hex(), point.hex(), *sizes]
    packet = hello("n1", own.passwords["mqtt"]).hex()
    return subprocess.run([probe, *words, packet], check=True, capture_output=True, text=True, timeout=60).stdout


@pytest.mark.live
@pytest.mark.parametrize("name", [BROKER_NAME, "fog.lan"])
def test_broker_lets_a_node_in_whose_buffers_fit_into_an_esp8266(probe, firmware, broker, security, name):
    assert answer(probe, firmware, broker, security, name) == "20020000\n"  # CONNACK, accepted


@pytest.mark.live
def test_address_of_the_broker_is_no_name_in_its_certificate(probe, firmware, broker, security):
    assert f"error {BAD_SERVER_NAME}" in answer(probe, firmware, broker, security, "127.0.0.1")


@pytest.mark.live
def test_broker_of_another_authority_is_not_trusted(probe, firmware, broker, security, tmp_path):
    stranger = SiteSecurity(tmp_path / "stranger", "lab")
    stranger.make(["127.0.0.1"], nodes=["n1"])
    assert f"error {NOT_TRUSTED}" in answer(probe, firmware, broker, stranger, BROKER_NAME)
