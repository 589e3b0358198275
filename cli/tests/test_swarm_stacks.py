"""Stack files of floors on several machines, without an engine: what they name exists, and nothing is forgotten."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from cryptography import x509
from typer.testing import CliRunner

from console_service.floors import read_peers
from fog_runtime.configuration.site import load_site
from fog_runtime.token_file import read_tokens, token_hash
from fognav.__main__ import app
from fognav.hosting.swarm_stacks import LIMIT

ROOT = Path(__file__).parents[2]
COMPOSE = (ROOT / "docker-compose.yml").read_text("utf-8")
FLOORS = ("ground", "upstairs")
TWICE = "attic"
"""A floor with three machines."""


def floor(folder: Path, site: str) -> Path:
    made = shutil.copytree(ROOT / "sites" / "estig", folder / site)
    text = (made / "site.toml").read_text("utf-8")
    (made / "site.toml").write_text(text.replace('id = "estig"', f'id = "{site}"', 1), "utf-8")
    return made


def stack(*arguments: str | Path, code: int = 0) -> str:
    done = CliRunner().invoke(app, ["stack", *map(str, arguments)])
    assert done.exit_code == code, done.output
    return done.output


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("sites")
    return [f"{floor(folder, name)}@{name}.local" for name in FLOORS]


@pytest.fixture(scope="module")
def out(words: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stacks")
    stack(*words, "--out", folder, "--images", "registry.local:5000/")
    attic = floor(tmp_path_factory.mktemp("attic"), TWICE)
    stack(f"{attic}@a.local,b.local,c.local", "--out", folder)
    return folder


def made(out: Path, name: str) -> dict[str, Any]:
    return yaml.safe_load((out / f"{name}.yml").read_text("utf-8"))


@pytest.mark.parametrize("name", [*FLOORS, TWICE])
def test_each_secret_and_config_of_a_stack_is_a_small_file_beside_it_and_each_is_used(out: Path, name: str) -> None:
    found = made(out, name)
    for kind in ("secrets", "configs"):
        used = {each["source"] for service in found["services"].values() for each in service[kind]}
        assert used == found[kind].keys()
        for each in found[kind].values():
            assert (out / each["file"]).stat().st_size <= LIMIT
            assert len(each["name"]) <= 64
        assert len({each["name"] for each in found[kind].values()}) == len(found[kind])


def test_stack_has_every_service_that_always_runs_on_the_machine_of_its_floor(out: Path) -> None:
    base = yaml.safe_load(COMPOSE)["services"]
    found = made(out, "upstairs")
    lasting = {name: each for name, each in base.items() if each["restart"] != "no" and "profiles" not in each}
    assert found["services"].keys() == lasting.keys()
    assert {"planner", "redis", "zenoh", "gateway"} <= lasting.keys()
    for name, service in found["services"].items():
        assert service["deploy"]["placement"]["constraints"] == ["node.labels.fognav.floor == upstairs"]
        assert service["image"] == base[name]["image"].replace("fognav/", "registry.local:5000/")
        assert set(service["networks"]) <= found["networks"].keys()
        mounted = {each.partition(":")[0] for each in service["volumes"] if isinstance(each, str)}
        assert [each["target"] for each in service["volumes"] if isinstance(each, dict)] == base[name].get("tmpfs", [])
        assert mounted <= found["volumes"].keys(), "nothing of the machine itself is mounted"
        targets = [each["target"] for kind in ("secrets", "configs") for each in service[kind]]
        assert len(set(targets)) == len(targets)


def test_site_of_a_stack_is_the_one_that_was_given_with_its_map(out: Path, words: list[str]) -> None:
    given, taken = load_site(Path(words[1].partition("@")[0])), load_site(out / "upstairs" / "configs" / "site")
    assert taken.site == given.site
    assert (taken.map.cells == given.map.cells).all()


def test_each_console_lists_the_other_floors_with_a_token_that_is_valid_there(out: Path) -> None:
    for here, there in (FLOORS, FLOORS[::-1]):
        folder = out / here / "secrets" / "console-service"
        (peer,) = read_peers(folder / "floors.toml", here)
        assert (peer.id, peer.addresses) == (there, (f"https://{there}.local",))
        tokens = {each.sha256: each for each in read_tokens(out / there / "secrets" / "planner" / "tokens.toml")}
        assert tokens[token_hash(peer.token)].role == "viewer"
        environment = made(out, here)["services"]["console-service"]["environment"]
        assert environment["FOGNAV_FLOORS_FILE"] == "/run/fognav/floors.toml"
    own = [tomllib.loads((out / each / "secrets/planner/credentials.toml").read_text("utf-8")) for each in FLOORS]
    assert own[0]["authority"] != own[1]["authority"], "each floor trusts its own authority alone"


def test_stack_that_is_written_again_keeps_its_credentials_and_names(out: Path, words: list[str]) -> None:
    before = made(out, "ground")
    stack(*words, "--out", out, "--images", "registry.local:5000/")
    assert made(out, "ground") == before


@pytest.mark.skipif(shutil.which("docker") is None, reason="needs the command docker")
@pytest.mark.parametrize("name", [*FLOORS, TWICE])
def test_docker_reads_the_stack(out: Path, name: str) -> None:
    done = subprocess.run(
        ["docker", "stack", "config", "-c", f"{name}.yml"], cwd=out, capture_output=True, text=True, check=False
    )
    if "is not a docker command" in done.stderr or "unknown command" in done.stderr:
        pytest.skip("this docker has no `stack config`, which 25 has")
    assert done.returncode == 0, done.stderr


def machine_of(service: dict[str, Any]) -> str:
    (found,) = re.findall(r"fognav\.machine == (\d)", " ".join(service["deploy"]["placement"]["constraints"]))
    return str(found)


def test_floor_with_three_machines_runs_twice_and_redis_three_times(out: Path) -> None:
    services = made(out, TWICE)["services"]
    machines = {name: machine_of(service) for name, service in services.items()}
    assert {name for name, machine in machines.items() if machine == "3"} == {"redis-3", "sentinel-3"}
    first = {name for name, machine in machines.items() if machine == "1"} - {"prometheus", "grafana"}
    assert {f"{name}-2" for name in first} == {name for name, machine in machines.items() if machine == "2"}
    ends = {name for name, each in services.items() if each.get("sysctls") == {"net.ipv4.tcp_retries2": 5}}
    wanted = {"planner", "map-service", "hazard-aggregator", "console-service", "zenoh"}
    assert ends == wanted | {f"{name}-2" for name in wanted}, "connections to a machine that is cut off end in seconds"


def test_files_of_the_machines_are_together_the_whole_stack(out: Path) -> None:
    parts = {machine: made(out, f"{TWICE}.{machine}") for machine in "123"}
    for kind, whole in made(out, TWICE).items():
        together = (
            {name: each for part in parts.values() for name, each in part[kind].items()} if kind != "version" else whole
        )
        assert together == whole
    assert {machine_of(each) for each in parts["2"]["services"].values()} == {"2"}


def names_in(networks: Any, name: str) -> dict[str, set[str]]:
    """Return by which names a service is known in each of its networks."""
    listed = networks if isinstance(networks, dict) else dict.fromkeys(networks)
    return {network: {name, *((settings or {}).get("aliases", []))} for network, settings in listed.items()}


def test_every_server_that_a_copy_names_is_in_a_network_with_it_and_its_certificate_has_the_name(out: Path) -> None:
    services = made(out, TWICE)["services"]
    known = {name: names_in(service["networks"], name) for name, service in services.items()}
    certificates = {
        each: (out / TWICE / "secrets" / each / "server.pem").read_bytes() for each in ("redis", "zenoh", "gateway")
    }
    named: set[str] = set()
    for name, service in services.items():
        near = {other: set().union(*(by[n] for n in by.keys() & known[name].keys())) for other, by in known.items()}
        needed = {
            key: each
            for key, each in service["environment"].items()
            if key != "FOGNAV_MQTT_URL" or "nodes" in known[name]
        }
        text = "\n".join([*needed.values(), *map(str, service.get("command", []))])
        for host in re.findall(r"(?:(?<=//)|(?<=tls/)|(?<=,))([a-z-]+\d?)(?=:\d+)", text):
            assert [other for other in near if host in near[other]], f"{name} knows no {host}"
            named.add(host)
    assert {"redis", "sentinel-3", "zenoh-2", "mosquitto-2", "gateway-2"} - named == {"redis"}
    for data in certificates.values():
        (names,) = (
            each.value.get_values_for_type(x509.DNSName)
            for each in x509.load_pem_x509_certificate(data).extensions
            if isinstance(each.value, x509.SubjectAlternativeName)
        )
        assert named <= {*names}


def test_copies_share_no_volume_and_have_the_same_secrets(out: Path) -> None:
    found = made(out, TWICE)
    kept: dict[str, set[str]] = {}
    for service in found["services"].values():
        volumes = {each.partition(":")[0] for each in service["volumes"] if isinstance(each, str)}
        kept.setdefault(machine_of(service), set()).update(volumes)
    assert len(set().union(*kept.values())) == sum(map(len, kept.values())), "two machines labelled alike share data"
    for name in ("planner", "console-service", "gateway", "zenoh"):
        own, other = (
            {
                each["target"]: (out / found["secrets"][each["source"]]["file"]).read_bytes()
                for each in service["secrets"]
            }
            for service in (found["services"][name], found["services"][f"{name}-2"])
        )
        assert own == other, name


@pytest.mark.parametrize("hosts", ["a.local,b.local", "a.local,a.local,b.local"])
def test_floor_with_two_machines_is_refused(tmp_path: Path, hosts: str) -> None:
    assert "3" in stack(f"sites/estig@{hosts}", "--out", tmp_path, code=2)


@pytest.mark.parametrize("word", ["sites/estig", "@fog.local", "sites/estig@fog local"])
def test_floor_without_a_machine_is_refused(tmp_path: Path, word: str) -> None:
    said = stack(word, "--out", tmp_path, code=2)
    assert "sites/upstairs@fog2.local" in said.replace("\n", " ")
