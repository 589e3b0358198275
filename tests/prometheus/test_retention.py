"""How long Prometheus keeps what it measured: a real one, started with the flags of docker-compose.yml."""

import json
import re
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path

import pytest
import yaml

from fog_supervisor import child, net

pytestmark = [
    pytest.mark.live,
    pytest.mark.skipif(shutil.which("prometheus") is None, reason="prometheus is not installed"),
]

COMPOSE = yaml.safe_load((Path(__file__).parents[2] / "docker-compose.yml").read_text("utf-8"))


def flags(chosen: dict[str, str]) -> list[str]:
    """Return the flags of retention, with these values of their variables and the defaults of the others."""
    command = COMPOSE["services"]["prometheus"]["command"]
    found = [flag for flag in command if flag.startswith("--storage.tsdb.retention")]
    assert len(found) == 2
    return [re.sub(r"\$\{(\w+):-([^}]*)\}", lambda name: chosen.get(name[1], name[2]), flag) for flag in found]


@pytest.mark.parametrize(
    ("chosen", "kept"),
    [({}, "30d or 2GiB"), ({"FOGNAV_PROMETHEUS_DAYS": "7", "FOGNAV_PROMETHEUS_SIZE": "512MB"}, "1w or 512MiB")],
    ids=["default", "chosen"],
)
def test_prometheus_keeps_samples_for_the_time_and_the_size_of_the_settings(tmp_path, chosen, kept):
    file, port = tmp_path / "prometheus.yml", net.free_port()
    file.write_text("global: {}\n")
    address = f"127.0.0.1:{port}"
    command = ["prometheus", f"--config.file={file}", f"--storage.tsdb.path={tmp_path / 'data'}", *flags(chosen)]
    with (tmp_path / "log").open("wb") as log:
        server = subprocess.Popen(child.command(*command, f"--web.listen-address={address}"), stdout=log, stderr=log)
    try:
        deadline = time.monotonic() + 60.0
        while True:
            try:
                with urllib.request.urlopen(f"http://{address}/api/v1/status/runtimeinfo", timeout=5) as answer:
                    said = json.load(answer)["data"]["storageRetention"]
                break
            except OSError:
                assert server.poll() is None, (tmp_path / "log").read_text()
                assert time.monotonic() < deadline, (tmp_path / "log").read_text()
                time.sleep(0.05)
    finally:
        server.terminate()
        server.wait(30)
    assert said == kept
