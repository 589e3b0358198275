"""What docker-compose.yml says, without an engine (tests/compose runs it on one)."""

from pathlib import Path

import yaml

COMPOSE = yaml.safe_load((Path(__file__).parents[1] / "docker-compose.yml").read_text("utf-8"))


def test_no_registry_is_asked_for_an_image_of_ours():
    ours = {name: service for name, service in COMPOSE["services"].items() if service["image"].startswith("fognav/")}
    assert len(ours) >= 6
    assert [name for name, service in ours.items() if "build" not in service] == []


def test_services_of_one_image_are_built_alike():
    builds: dict[str, list[object]] = {}
    for service in COMPOSE["services"].values():
        builds.setdefault(service["image"], []).append(service.get("build"))
    assert [image for image, found in builds.items() if any(build != found[0] for build in found)] == []
