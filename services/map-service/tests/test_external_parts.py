"""An external package registers a debounce rule and a cost layer; the real processes use both by name."""

import asyncio
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import httpx
import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import AreaHazard, MapSnapshot, NodeReading, RobotPose
from fog_contracts.replica import Replica

pytest.importorskip("hazard_aggregator")
pytestmark = pytest.mark.live

PACKAGE = Path(__file__).parents[3] / "tests" / "fixtures" / "external-parts"
SECONDS = 0.4
COST = 80
LAYERS = f'layers = ["static", "hazards", "zones", "obstacles", {{ name = "visited", cost = {COST}, seconds = 1.5 }}]'


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """Build the package as its author would, and install it into a folder."""
    source = tmp_path_factory.mktemp("source") / "external-parts"
    shutil.copytree(PACKAGE, source)
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(source / "dist")]
    subprocess.run(command, cwd=source, check=True, capture_output=True, timeout=120)
    (wheel,) = (source / "dist").glob("*.whl")
    target = tmp_path_factory.mktemp("installed")
    # A wheel of plain Python is installed by unpacking it.
    zipfile.ZipFile(wheel).extractall(target)
    return target


@pytest.fixture
def fog_with_parts(fog, installed: Path):
    """A fog whose processes can import the package, at a site that is configured to use its parts."""
    fog.environment["PYTHONPATH"] = os.pathsep.join(
        part for part in (str(installed), os.environ.get("PYTHONPATH", "")) if part
    )
    configure(fog, f'number = 7\ndebounce = {{ rule = "sustained", seconds = {SECONDS} }}', LAYERS)
    return fog


def configure(fog, area: str, layers: str) -> None:
    file = fog.site / "site.toml"
    text = file.read_text().replace("number = 7", area).replace('map = "map.yaml"', f'map = "map.yaml"\n{layers}')
    file.write_text(text)


def pose(x: float, y: float) -> RobotPose:
    return RobotPose(x=x, y=y, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.35, stamp=0.0)


async def cost(zenoh, x: float, y: float) -> int | None:
    """Return the cost of a point (m) on the served map, or None before the map-service serves it."""
    snapshot = await zenoh.query(ch.MAP_SNAPSHOT, None, MapSnapshot, 1.0)
    if snapshot is None:
        return None
    replica = Replica()
    replica.load(snapshot)
    column, row = replica.geometry.cell(x, y)
    return int(replica.cost[row, column])


async def test_debounce_rule_and_cost_layer_of_an_external_package_work_in_the_running_services(fog_with_parts):
    fog = fog_with_parts
    for module in ("hazard_aggregator", "map_service"):
        fog.start(module)
    url = await fog.ready("hazard_aggregator")
    await fog.ready("map_service")
    async with httpx.AsyncClient(base_url=url, timeout=60) as client:
        (area,) = (await client.get("/api/v1/areas")).json()
        assert area["definition"]["debounce"] == {"rule": "sustained", "seconds": SECONDS}
    async with fog.edges() as (mqtt, zenoh, connect):
        hazards: list[AreaHazard] = []
        mqtt.on(ch.AREA_HAZARD, lambda _, hazard: hazards.append(hazard), AreaHazard)
        connect()
        await mqtt.wait_connected()
        seq = 0
        async with asyncio.timeout(60):
            while not hazards or hazards[-1].state != "blocked":
                reading = NodeReading(
                    seq=seq, boot=1, uptime_ms=100 * seq, range_m=[0.8, 3.0], status=["ok", "ok"], state="blocked"
                )
                await mqtt.publish(ch.NODE_READING, reading, node="n1")
                seq += 1
                await asyncio.sleep(0.02)
            trace = hazards[-1].trace
            assert trace is not None
            assert trace.confirmed - trace.first_reading >= SECONDS - 0.01
            for _ in iter(int, 1):
                zenoh.publish(ch.ROBOT_POSE, pose(6.0, 3.0), robot="r1")
                if await cost(zenoh, 6.0, 3.0) == COST:
                    break
            for _ in iter(int, 1):
                if await cost(zenoh, 6.0, 3.0) == 0:
                    break
                await asyncio.sleep(0.05)


@pytest.mark.parametrize(
    ("module", "area", "layers", "expected"),
    [
        ("hazard_aggregator", 'debounce = { rule = "sustaned" }', "", ("area hall", "debounce.rule", "sustained")),
        ("hazard_aggregator", 'debounce = { rule = "sustained", seconds = 0 }', "", ("area hall", "debounce.seconds")),
        ("map_service", "", LAYERS.replace("visited", "visted"), ("layers[4]", "visted", "visited")),
        ("map_service", "", LAYERS.replace("seconds = 1.5", "seconds = 0"), ("layers[4] (visited)", "seconds")),
    ],
)
async def test_invalid_choice_of_a_part_ends_the_start_naming_its_place_and_the_known_parts(
    fog, installed, module, area, layers, expected
):
    fog.environment["PYTHONPATH"] = str(installed)
    configure(fog, f"number = 7\n{area}", layers)
    fog.start(module)
    status = await asyncio.to_thread(fog.processes[module].wait, 30)
    assert status != 0
    for text in expected:
        assert text in fog.log(module)
