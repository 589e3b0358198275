"""One fog node in containers for two floors, on a real engine: `fognav site compose`."""

from __future__ import annotations

import asyncio
import shutil
from typing import TYPE_CHECKING, Final

import pytest
from compose_project import (
    BUILD_S,
    FOG,
    ROOT,
    SERVICES,
    Project,
    leftovers,
    skip_reason,
    token,
    wait,
    wait_health,
    watching,
    wrong_targets,
)

from fog_contracts import channels as ch
from fog_contracts.messages import RobotState

if TYPE_CHECKING:
    from collections.abc import Iterator

SKIP_REASON: Final = skip_reason()
pytestmark = [
    pytest.mark.compose,
    pytest.mark.timeout(2 * BUILD_S + 1800),
    pytest.mark.skipif(SKIP_REASON is not None, reason=SKIP_REASON or ""),
]
SHARED: Final = {"zenoh", "mosquitto", "mosquitto-relay", "redis"}
UPSTAIRS: Final = "upstairs"
OWN: Final = {f"{name}-{UPSTAIRS}" for name in FOG - SHARED}
ZONE: Final = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [9.0, 42.6], "radius": 0.5}, "reason": "wet"}
BOX: Final = {"state": "blocked", "ttl_s": 3600.0, "reason": "box"}


@pytest.fixture(scope="module")
def building(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Project]:
    """Two floors of the same map, with a simulated robot on each."""
    folder = tmp_path_factory.mktemp("floors")
    site = shutil.copytree(ROOT / "sites" / "estig", folder / UPSTAIRS)
    text = (site / "site.toml").read_text("utf-8")
    (site / "site.toml").write_text(text.replace('id = "estig"', f'id = "{UPSTAIRS}"', 1), "utf-8")
    project = Project(folder, [site])
    project("build", timeout_s=BUILD_S)
    try:
        project("up", "--detach", "--no-build", timeout_s=BUILD_S)
        project.wait_healthy({*FOG, *OWN})
        yield project
    finally:
        project("down", "--volumes", "--remove-orphans", "--timeout", "10")
        assert leftovers(project.name) == []


def states(building: Project, floor: str) -> dict[str, str]:
    """Return the state of each area of a floor."""
    areas = building.get("/api/v1/areas", floor=floor).json()
    return {area["definition"]["id"]: area["hazard"]["state"] for area in areas}


def test_floors_share_broker_store_and_router_and_the_gateways_way_out_alone(building: Project) -> None:
    containers = building.containers()
    assert {name for name in containers if name in SHARED or name.endswith(UPSTAIRS)} == {
        *SHARED, *OWN, f"sim-robot-{UPSTAIRS}",
    }  # fmt: skip
    networks = {name: set(each["NetworkSettings"]["Networks"]) for name, each in containers.items()}
    for service in (*SERVICES, "prometheus"):
        assert networks[service].isdisjoint(networks[f"{service}-{UPSTAIRS}"])


@pytest.mark.parametrize("floor", ["", UPSTAIRS])
async def test_robot_drives_on_each_floor(building: Project, floor: str) -> None:
    robot = f"sim-robot-{floor}" if floor else "sim-robot"
    await asyncio.to_thread(wait_health, building, robot, "healthy")
    async with watching(building, floor) as edge:
        states_of = edge.latest(ch.ROBOT_STATE, RobotState, robot="r1")

        def missing() -> str | None:
            state = states_of.get()
            return None if state is not None and state.mode == "NORMAL" and state.enabled else f"{state}"

        await asyncio.to_thread(wait, missing, 90)


def test_hazard_and_zone_stay_on_their_floor(building: Project) -> None:
    for floor in ("", UPSTAIRS):
        wait(lambda floor=floor: None if set(states(building, floor).values()) == {"clear"} else "not clear", 60)  # type: ignore[misc]  # mypy takes no default of a lambda
    here = token(building)
    answer = building.request("PUT", "/api/v1/areas/z1/override", json=BOX, headers=here)
    assert answer.status_code < 300, answer.text
    wait(lambda: None if states(building, "")["z1"] == "blocked" else "the hazard is not announced", 30)
    zone = building.request("POST", "/api/v1/zones", json=ZONE, headers=token(building, UPSTAIRS), floor=UPSTAIRS)
    assert zone.status_code == 201, zone.text
    assert set(states(building, UPSTAIRS).values()) == {"clear"}
    assert zone.json()["id"] not in building.get("/api/v1/zones").text


def test_token_of_a_floor_is_worth_nothing_on_another(building: Project) -> None:
    refused = building.request("POST", "/api/v1/zones", json=ZONE, headers=token(building), floor=UPSTAIRS)
    assert refused.status_code == 401


@pytest.mark.parametrize("floor", ["", UPSTAIRS])
def test_prometheus_of_each_floor_sees_its_services_and_its_robot(building: Project, floor: str) -> None:
    wait(lambda: wrong_targets(building, *SERVICES, "r1", floor=floor), 60)
