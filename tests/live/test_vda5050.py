"""A fleet control drives the robot of `fognav up --sim --bridge` by VDA 5050, until an operator takes over."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from secured_servers import TESTER, SecuredSite
from test_up import START_S, Node
from vda5050_floor import header, node, schema

from fog_runtime.credentials import Credentials
from fog_runtime.transports.mqtt_connection import Broker

if TYPE_CHECKING:
    import aiomqtt

pytestmark = [pytest.mark.live, pytest.mark.drive, pytest.mark.timeout(600)]

LIBRARY = os.environ.get("FOGNAV_VDA5050_LIB", "")
"""The folder `node_modules` with npm's `vda-5050-lib`."""
MASTER = Path(__file__).parents[1] / "support" / "vda5050_master.cjs"


@asynccontextmanager
async def fleet(tmp_path: Path, version: str, *options: str):
    """Run a floor with a simulated robot under a fleet's control; yield the node, the fleet's broker and its user."""
    site = SecuredSite(tmp_path, "fleet")
    with site.mosquitto() as server:
        own = site.security.credentials(TESTER)
        settings = tmp_path / "bridge.toml"
        settings.write_text(
            f'adapters = "vda5050"\nvda5050_mqtt_url = "{server.url}"\nvda5050_credentials_file = "{own}"\n'
            f'vda5050_version = "{version}"\nvda5050_robots = "r1"\nvda5050_zones = "kit/0001"\n'
        )
        floor = Node(tmp_path, "--sim", "--bridge", str(settings), *options)
        try:
            await asyncio.to_thread(floor.up)
            pose = lambda: floor.json("robot", "status")["pose"] or {}  # noqa: E731  # shorter so
            await asyncio.to_thread(floor.wait, lambda: pose().get("localized"), "the robot knows where it is")
            await asyncio.to_thread(floor.run, "robot", "enable")
            yield floor, server.url, Credentials.read(own)
            await asyncio.to_thread(floor.down)
        finally:
            floor.end()


def order(x: float, y: float, *ahead: float, name: str, version: str) -> dict[str, Any]:
    """Return an order from (x, y) straight north, by nodes so many metres ahead: `name-1` and so on."""
    wide: Any = {"a": 0.4, "b": 0.4, "theta": 0.0} if version == "3.0" else 0.4
    nodes = [node(name, 0, x, y, position={"mapId": "estig"})]
    nodes += [
        node(f"{name}-{n}", 2 * n, x, y + metres, position={"mapId": "estig", "allowedDeviationXY": wide})
        for n, metres in enumerate(ahead, 1)
    ]
    edges = [
        {"edgeId": f"e{n}", "sequenceId": 2 * n - 1, "released": True, "actions": [],
         "startNodeId": nodes[n - 1]["nodeId"], "endNodeId": nodes[n]["nodeId"]}
        for n in range(1, len(nodes))
    ]  # fmt: skip
    return header(version) | {"orderId": name, "orderUpdateId": 0, "nodes": nodes, "edges": edges}


async def check_zones(floor: Node, client: aiomqtt.Client) -> None:
    """Check that a robot of others is told what is blocked and slow, as operators say."""
    others = "vda5050/v3/kit/0001/"
    await client.subscribe(others + "zoneSet")
    await client.publish(others + "connection", '{"connectionState": "ONLINE"}', qos=1, retain=True)
    await client.publish(others + "state", '{"zoneSets": []}')

    async def zones(wanted: set[tuple[str, str]]) -> None:
        found: Any = None
        with suppress(TimeoutError):
            async with asyncio.timeout(60.0):
                async for message in client.messages:
                    if message.topic.matches(others + "zoneSet"):
                        found = {
                            (zone["zoneId"], zone["zoneType"])
                            for zone in json.loads(message.payload)["zoneSet"]["zones"]
                        }
                        if found == wanted:
                            return
        raise AssertionError(f"{found} instead of {wanted}")

    await zones(set())
    await asyncio.to_thread(
        floor.run, "area", "override", "z2", "--state", "blocked", "--for", "10m", "--reason", "inspection"
    )
    await zones({("area-z2", "BLOCKED")})
    await asyncio.to_thread(
        floor.run, "zone", "add", "--id", "wet", "--rectangle", "32,38,36,40", "--kind", "speed-limit", "--speed", "0.1"
    )
    await zones({("area-z2", "BLOCKED"), ("zone-wet", "SPEED_LIMIT")})


def site_with_a_dock(folder: Path) -> Path:
    site = shutil.copytree(Path(__file__).parents[2] / "sites" / "estig", folder)
    text, start = (site / "site.toml").read_text(), "start = { x = 5.0, y = 25.4, theta = 1.5707963 }"
    assert start in text
    (site / "site.toml").write_text(text.replace(start, f"{start}\ndock = {{ x = 5.0, y = 28.4, theta = 1.5707963 }}"))
    return site


async def test_fleet_drives_the_robot_onto_its_dock_and_off_it_until_an_operator_takes_over(tmp_path):
    """And robots of others hear of what is blocked."""
    async with (
        fleet(tmp_path, "3.0", "--site", str(site_with_a_dock(tmp_path / "estig"))) as (floor, url, own),
        Broker.of(url, own).client("fleet", None) as client,
    ):
        await client.subscribe("vda5050/v3/fognav/r1/state")
        states = client.messages

        async def state(wanted, what: str) -> dict[str, Any]:
            last: Any = None
            with suppress(TimeoutError):
                async with asyncio.timeout(90.0):
                    async for message in states:
                        last = json.loads(message.payload)
                        passed.setdefault(last["lastNodeId"], last["driving"])
                        if wanted(last):
                            return last
            raise AssertionError(f"{what}: {last}\n{floor.run('logs', 'bridge')}")

        def is_done(told: dict[str, Any]) -> bool:
            return bool(told["actionStates"]) and told["actionStates"][0]["actionStatus"] in ("FINISHED", "FAILED")

        async def send(message: dict[str, Any], on_node: int | None = None, kind: str = "") -> None:
            if on_node is not None:
                message["nodes"][on_node]["actions"] = [{"actionType": kind, "actionId": kind, "blockingType": "HARD"}]
            await client.publish("vda5050/v3/fognav/r1/order", json.dumps(message))

        passed: dict[str, bool] = {}
        ask = {"actionType": "stateRequest", "actionId": "s", "blockingType": "NONE"}
        await client.publish("vda5050/v3/fognav/r1/instantActions", json.dumps(header() | {"actions": [ask]}))
        at = (await state(lambda s: s["operatingMode"] == "AUTOMATIC", "in control"))["mobileRobotPosition"]
        wall = order(at["x"], at["y"], 0.0, name="wall", version="3.0")
        wall["nodes"][1]["nodePosition"]["x"] += 2.0
        await send(wall)
        refused = await state(lambda s: s["errors"], "a node in a wall")
        assert [each["errorType"] for each in refused["errors"]] == ["NO_ROUTE_TO_TARGET"]

        await send(order(at["x"], at["y"], 0.6, 1.2, name="o1", version="3.0"), 2, "startCharging")
        under_way = await state(lambda s: s["driving"] and "plannedPath" in s, "it drives by a path")
        assert (under_way["orderId"], under_way["errors"]) == ("o1", [])
        if os.environ.get("FOGNAV_VDA5050_SCHEMAS"):
            schema("3.0", "state").validate(under_way)
        docked = await state(lambda s: s["orderId"] == "o1" and is_done(s), "it is on its dock")
        assert (docked["actionStates"][0]["actionStatus"], docked["operatingMode"]) == ("FINISHED", "AUTOMATIC"), docked
        assert (docked["nodeStates"], docked["edgeStates"]) == ([], [])
        assert passed["o1-1"], "it has not stopped at the node in between"
        assert docked["mobileRobotPosition"]["y"] > 28.0

        off = order(at["x"], at["y"] + 1.2, -1.2, name="o2", version="3.0")
        off["nodes"][0]["nodeId"] = off["edges"][0]["startNodeId"] = "o1-2"
        await send(off, 0, "stopCharging")
        left = await state(lambda s: s["orderId"] == "o2" and is_done(s), "it has left its dock")
        assert left["actionStates"][0]["actionStatus"] == "FINISHED", left
        await state(lambda s: s["orderId"] == "o2" and s["driving"], "it drives back")
        await asyncio.to_thread(floor.run, "robot", "take-out", "--reason", "repair")
        out = await state(lambda s: s["operatingMode"] == "SERVICE", "an operator takes it out of service")
        assert out["nodeStates"] == []
        await state(lambda s: not s["driving"], "it stands")

        await check_zones(floor, client)


@pytest.mark.skipif(
    not LIBRARY or not shutil.which("node"),
    reason="needs node, and npm install vda-5050-lib in a folder F, FOGNAV_VDA5050_LIB=F/node_modules",
)
@pytest.mark.parametrize("version", ["2.0", "1.1"])
async def test_master_control_of_others_drives_the_robot_and_finds_no_message_malformed(tmp_path, version):
    async with fleet(tmp_path, version) as (_, url, own):
        found = order(5.0, 25.4, 1.5, 3.0, name="o1", version=version)
        given = {
            "url": url.replace("127.0.0.1", "localhost"), "username": own.user, "password": own.passwords["mqtt"],
            "ca": own.authority, "version": f"{version}.0", "agv": {"manufacturer": "fognav", "serialNumber": "r1"},
            "order": {name: found[name] for name in ("orderId", "orderUpdateId", "nodes", "edges")},
        }  # fmt: skip
        process = await asyncio.create_subprocess_exec(
            "node", str(MASTER), json.dumps(given), env={**os.environ, "NODE_PATH": LIBRARY, "DEBUG": "vda-5050:*"},
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        try:
            said, log = await asyncio.wait_for(process.communicate(), START_S)
        finally:
            if process.returncode is None:
                process.kill()
        lines = [json.loads(line) for line in said.splitlines()]
        assert {"what": "processed", "error": None, "cancelled": False, "active": False} in lines, (lines, log[-3000:])
        assert [line["node"] for line in lines if line["what"] == "traversed"] == ["o1", "o1-1", "o1-2"]
        assert {"what": "action", "status": "FINISHED"} in lines
        expected = {"visualization", "connection"} | ({"factsheet"} if version == "2.0" else set())
        assert expected <= {line["what"] for line in lines}
        assert b"invalid" not in log.lower(), log[-3000:]
