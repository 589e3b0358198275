"""The override by which one fog node in containers serves further floors, without an engine (tests/compose has one)."""

import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from fognav.__main__ import app
from fognav.hosting.compose_floors import BASE, override
from fognav.output import WrongUseError

ROOT = Path(__file__).parents[2]
COMPOSE = (ROOT / BASE).read_text("utf-8")
SERVERS = ("mosquitto-relay", "redis", "zenoh")


def floor(folder: Path, site: str) -> Path:
    shutil.copytree(ROOT / "sites" / "estig", folder / site)
    file = folder / site / "site.toml"
    file.write_text(file.read_text("utf-8").replace('id = "estig"', f'id = "{site}"', 1), "utf-8")
    return folder / site


@pytest.fixture
def made(tmp_path: Path) -> dict[str, Any]:
    return yaml.safe_load(override([floor(tmp_path, "attic"), floor(tmp_path, "first-floor")], COMPOSE))


def test_written_file_names_the_command_that_writes_it_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = [floor(tmp_path / "with space", "attic"), floor(tmp_path, "first-floor")]
    out = tmp_path / "override.yml"
    assert CliRunner().invoke(app, ["site", "compose", *map(str, folders), "--out", str(out)]).exit_code == 0
    first, written = out.read_text("utf-8").split("\n", 1)
    named = first.split("`")[1]
    out.unlink()
    assert CliRunner().invoke(app, [*shlex.split(named)[1:], "--out", str(out)]).exit_code == 0
    assert out.read_text("utf-8").split("\n", 1)[1] == written


def test_each_floor_has_every_container_but_the_shared_ones(made):
    base = yaml.safe_load(COMPOSE)["services"]
    shared = {*SERVERS, "mosquitto", "credentials", "bridge-credentials", "sim-credentials", "kernels"}
    expected = {f"{name}-{site}" for name in base.keys() - shared for site in ("attic", "first-floor")}
    assert made["services"].keys() - shared == expected


def test_no_container_of_a_floor_but_the_gateway_is_in_a_network_with_one_of_another(made):
    base = yaml.safe_load(COMPOSE)["services"]
    assert {name for name, each in made["services"].items() if "outside" in each.get("networks", [])} == {
        "gateway-attic", "gateway-first-floor",
    }  # fmt: skip
    of = {name: set(each.get("networks", [])) - {"outside"} for name, each in made["services"].items()}
    first = {network for each in base.values() for network in each.get("networks", [])} - {"outside"}
    for site in ("attic", "first-floor"):
        here = set().union(*(networks for name, networks in of.items() if name.endswith(site)))
        others = set().union(*(networks for name, networks in of.items() if name.endswith("attic") is (site != "attic")
                               and name not in SERVERS))  # fmt: skip
        assert here == {f"{name}-{site}" for name in first}
        assert here.isdisjoint(others | first)


def test_its_containers_answer_to_the_usual_names(made):
    for name in ("planner", "gateway", "prometheus"):
        networks = made["services"][f"{name}-attic"]["networks"]
        assert {tuple(each["aliases"]) for each in networks.values() if each} == {(name,)}
    broker = made["services"]["mosquitto-relay"]["networks"]
    assert broker == {name: {"aliases": ["mosquitto"]} for name in ("nodes-attic", "nodes-first-floor")}
    assert made["services"]["zenoh"]["networks"].keys() == {"robots-attic", "robots-first-floor"}


def test_ports_of_each_floor_are_ten_above_those_of_the_one_before(made):
    ports = made["services"]["gateway-attic"]["ports"], made["services"]["gateway-first-floor"]["ports"]
    assert ports[0][1] == "${FOGNAV_BIND:-0.0.0.0}:${FOGNAV_AGGREGATOR_PORT_ATTIC:-8011}:8001"
    assert ports[1][1] == "${FOGNAV_BIND:-0.0.0.0}:${FOGNAV_AGGREGATOR_PORT_FIRST_FLOOR:-8021}:8001"


def test_no_floor_has_the_data_or_the_secrets_of_another(made, tmp_path):
    def mounted(site: str) -> set[str]:
        found = (each.get("volumes", []) for name, each in made["services"].items() if name.endswith(site))
        return {text.partition(":")[0] for volumes in found for text in volumes if not text.startswith(("./", "$"))}

    base = set(yaml.safe_load(COMPOSE)["volumes"])
    assert mounted("attic") & mounted("first-floor") == {"kernels", "gateway-locks"}
    assert mounted("attic") & base == {"kernels", "gateway-locks"}
    handed_out = made["services"]["credentials"]["volumes"]
    assert f"{tmp_path / 'attic'}:/floors/attic:ro" in handed_out
    assert "planner-locks-attic:/out/floors/attic/planner" in handed_out
    assert {*made["volumes"]} >= {text.partition(":")[0] for text in handed_out if not text.startswith("/")}


def test_folder_that_ends_with_its_site_s_id_is_not_declared_as_a_volume(tmp_path):
    made = yaml.safe_load(override([floor(tmp_path, "attic").rename(tmp_path / "house-attic")], COMPOSE))
    assert f"{tmp_path / 'house-attic'}:/site:ro" in made["services"]["planner-attic"]["volumes"]
    assert {name.removesuffix("-attic") for name in made["volumes"]} <= yaml.safe_load(COMPOSE)["volumes"].keys()


def test_backup_of_a_floor_has_what_is_its_own(made):
    environment = made["services"]["backup-attic"]["environment"]
    assert environment["FOGNAV_TOKENS_FILE"] == "/locks/floors/attic/tokens.toml"


def test_two_floors_of_one_id_are_refused(tmp_path):
    one = floor(tmp_path, "attic")
    with pytest.raises(WrongUseError, match="have the same id 'attic'"):
        override([one, shutil.copytree(one, tmp_path / "copy")], COMPOSE)


def test_override_of_somebody_else_is_left_alone_and_ones_own_is_replaced(tmp_path):
    out, site = tmp_path / "override.yml", str(floor(tmp_path, "attic"))
    out.write_text("services: {}\n")
    refused = CliRunner().invoke(app, ["site", "compose", site, "--out", str(out)])
    assert (refused.exit_code, out.read_text()) == (2, "services: {}\n")
    assert "not by this command" in refused.output
    out.unlink()
    for _ in range(2):
        assert CliRunner().invoke(app, ["site", "compose", site, "--out", str(out)]).exit_code == 0
    assert "planner-attic:" in out.read_text()
    assert CliRunner().invoke(app, ["site", "compose", "--out", str(out)]).exit_code == 0
    assert not out.exists()
