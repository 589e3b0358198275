"""What docker-compose.yml says, without an engine (tests/compose runs it on one)."""

import re
from fnmatch import fnmatch
from pathlib import Path, PurePath
from typing import Any

import yaml

from fog_runtime.security.__main__ import BRIDGE, OWNERS, SIMULATION

ROOT = Path(__file__).parents[1]
COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
OPTIONAL = {"sim-credentials": SIMULATION, "bridge-credentials": BRIDGE}
HANDS_OUT = {"credentials", *OPTIONAL}
BEHIND = {"hazard-aggregator", "map-service", "planner", "console-service"}
PI_MIB = 4096
"""Memory of the Raspberry Pi on which a fog node is to run."""


def mounts(service: str) -> dict[str, str]:
    """Return what a service mounts, by its path there."""
    # A variable with a default has a colon of its own.
    volumes = [re.sub(r"\$\{[A-Z_]+:-([^}]*)\}", r"\1", text) for text in SERVICES[service].get("volumes", [])]
    return {path: source for source, path in (text.split(":")[:2] for text in volumes)}


def mebibytes(limit: str) -> int:
    return int(limit.removesuffix("m"))


def test_no_registry_is_asked_for_an_image_of_ours():
    ours = {name: service for name, service in SERVICES.items() if service["image"].startswith("fognav/")}
    assert len(ours) >= 6
    assert [name for name, service in ours.items() if "build" not in service] == []
    assert {service.get("pull_policy") for service in ours.values()} == {"never"}


def test_images_of_others_have_a_version_and_a_digest_and_are_pulled_if_missing():
    others = [service for service in SERVICES.values() if not service["image"].startswith("fognav/")]
    pinned = re.compile(r":v?\d+\.\d+\.\d+(-\w+)?@sha256:[0-9a-f]{64}$")
    assert [service["image"] for service in others if not pinned.search(service["image"])] == []
    assert {service["pull_policy"] for service in others} == {"missing"}


def test_base_of_our_images_has_a_digest_and_each_image_its_own_pins():
    dockerfile = (ROOT / "deploy" / "images" / "Dockerfile").read_text("utf-8")
    assert re.search(r"^ARG BASE=python:3\.11-slim-bookworm@sha256:[0-9a-f]{64}$", dockerfile, re.MULTILINE)
    assert set(re.findall(r"^FROM (\S+)", dockerfile, re.MULTILINE)) == {"${BASE}", "packages", "scratch"}
    builds = [service["build"]["args"] for service in SERVICES.values() if "build" in service]
    assert [build["NAME"] for build in builds if not (ROOT / "requirements" / f"{build['NAME']}.txt").is_file()] == []
    assert [path for build in builds for path in build["MEMBERS"].split() if not (ROOT / path).is_dir()] == []


def test_engine_is_sent_all_that_images_are_built_of():
    sent = [line[1:] for line in (ROOT / ".dockerignore").read_text("utf-8").splitlines() if line.startswith("!")]
    dockerfile = (ROOT / "deploy" / "images" / "Dockerfile").read_text("utf-8")
    copied = re.findall(r"^COPY (?!--from)(.+) \S+$", dockerfile, re.MULTILINE)
    needed = {path.replace("${NAME}", "planner") for paths in copied for path in paths.split()}
    assert {"libs", "bridges", "deploy/images/start", "requirements/planner.txt"} <= needed
    left_out = [path for path in needed if not any(PurePath(path).is_relative_to(s) or fnmatch(path, s) for s in sent)]
    assert left_out == []


def test_a_plain_up_shows_the_robots_cpu_by_grafana_and_by_prometheus_itself():
    """Grafana is left out by a variable; what nobody has to install shows the same."""
    grafana, prometheus = SERVICES["grafana"], SERVICES["prometheus"]
    assert "profiles" not in grafana
    assert grafana["scale"] == "${FOGNAV_GRAFANA:-1}"
    assert "--web.console.templates=/etc/prometheus/consoles" in prometheus["command"]
    assert (ROOT / mounts("prometheus")["/etc/prometheus"] / "consoles" / "robots.html").is_file()
    links = re.findall(r'href="(/[^"]*)"', (ROOT / "deploy" / "gateway" / "Caddyfile").read_text("utf-8"))
    assert "/prometheus/consoles/robots.html" in links


def test_services_of_one_image_are_built_alike():
    builds: dict[str, list[object]] = {}
    for service in SERVICES.values():
        builds.setdefault(service["image"], []).append(service.get("build"))
    assert [image for image, found in builds.items() if any(build != found[0] for build in found)] == []


def test_each_program_mounts_its_own_credentials_and_no_other_s():
    readers: dict[str, set[str]] = {}
    for name in SERVICES.keys() - HANDS_OUT:
        for source in mounts(name).values():
            if source.endswith("locks"):
                readers.setdefault(source, set()).add(name)
    own = {f"{program}-locks": {program} for program in OWNERS if program != SIMULATION}
    own["mosquitto-locks"].add("mosquitto-relay")
    assert readers == {**own, "sim-locks": {"sim-robot"}, "locks": {"backup"}}


def test_whoever_hands_out_secrets_has_no_network_and_a_place_for_each_program():
    for name in HANDS_OUT:
        assert SERVICES[name]["network_mode"] == "none"
    for name, program in OPTIONAL.items():
        expected = {f"/out/{each}" for each in (OWNERS.keys() - {*OPTIONAL.values()}) | {program}}
        assert {path for path in mounts(name) if path[:5] == "/out/"} == expected
        assert {path: mounts(name)[path] for path in mounts("credentials")} == mounts("credentials")


def test_no_secret_is_in_an_environment_or_a_command():
    shown = yaml.safe_dump([[each.get("environment"), each.get("command")] for each in SERVICES.values()])
    assert not re.search(r"PASSWORD|SECRET|_TOKEN:|://[^/\s]+@", shown, re.IGNORECASE)


def test_only_broker_router_and_gateway_are_reachable_from_outside():
    assert {name for name, service in SERVICES.items() if "ports" in service} == {"mosquitto-relay", "zenoh", "gateway"}
    assert SERVICES["redis"]["networks"] == ["store"]
    internal = {name for name, network in COMPOSE["networks"].items() if network and network.get("internal")}
    assert internal == {"store", "web"}


def test_services_believe_the_gateway_and_nobody_else_for_whom_it_asks():
    believed = {name: SERVICES[name]["environment"].get("FOGNAV_HTTP_GATEWAY") for name in BEHIND}
    assert believed == dict.fromkeys(BEHIND, "gateway")
    assert "FORWARDED_ALLOW_IPS" not in (ROOT / "docker-compose.yml").read_text("utf-8")


def test_memory_limits_leave_room_on_a_raspberry_pi():
    assert [name for name, service in SERVICES.items() if "mem_limit" not in service] == []
    always = {name: service for name, service in SERVICES.items() if service.get("restart") != "no"}
    total = sum(mebibytes(service["mem_limit"]) for service in always.values() if "profiles" not in service)
    assert total < PI_MIB * 3 / 4


def test_example_of_settings_names_every_variable_with_its_default():
    text = (ROOT / "docker-compose.yml").read_text("utf-8")
    used = dict(re.findall(r"\$\{(FOGNAV_\w+):-([^}]*)\}", text))
    named = dict(re.findall(r"^(FOGNAV_\w+)=(.*)$", (ROOT / ".env.example").read_text("utf-8"), re.MULTILINE))
    assert named.keys() == used.keys()
    own = {"FOGNAV_HOSTS", "FOGNAV_BIND"}
    assert {name: named[name] for name in named.keys() - own} == {name: used[name] for name in used.keys() - own}
