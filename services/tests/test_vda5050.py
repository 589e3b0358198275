"""VDA 5050 as it is sent and received: the norm's schemas, damaged messages, zone sets, and a real broker."""

from __future__ import annotations

import asyncio
import json
import math
import os
import random
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from manual_clock import ManualClock
from secured_servers import TESTER, SecuredSite
from vda5050_floor import SETUP, STATE, VERSIONS, A, B, C, Floorplan, area, driving, header, node, order, schema

from fog_bridges.floor import REFUSED, Answer, Request
from fog_bridges.vda5050 import telling
from fog_bridges.vda5050.bridge import RobotLink, Vda5050Bridge
from fog_bridges.vda5050.connection import Sender, Setup
from fog_bridges.vda5050.incoming import MESSAGE_MAX, MessageError, Order, ReportedZoneSet, decoded
from fog_bridges.vda5050.zones import AGAIN_S, ZoneSets, ZoneUser
from fog_runtime.clock import SystemClock
from fog_runtime.credentials import Credentials
from fog_runtime.transports.mqtt_connection import Broker

if TYPE_CHECKING:
    from pathlib import Path

    import aiomqtt

DAMAGED = int(os.environ.get("FOGNAV_DAMAGED_ORDERS", "2000"))

# --- The norm's messages ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", VERSIONS)
def test_all_that_is_told_fits_the_published_schemas(version):
    floor = driving()
    schema(version, "state").validate(floor.said(version))
    schema(version, "state").validate(Floorplan().said(version))
    sender = Sender(SETUP, version, "fognav", "r1")
    told = [
        ("factsheet", telling.factsheet(floor.robot, version)),
        ("visualization", telling.visualization(floor.robot, 3, 1.7e9)),
        *(("connection", {"connectionState": word}) for word in ("ONLINE", "OFFLINE", "CONNECTION_BROKEN")),
    ]
    for topic, content in told:
        schema(version, topic).validate(json.loads(sender.message(topic, content, 1.7e9)))


@pytest.mark.parametrize(("version", "power", "charge"), [("3.0", "powerSupply", "stateOfCharge"),
                                                          ("2.1", "batteryState", "batteryCharge")])  # fmt: skip
def test_battery_that_nobody_measures_is_not_told_as_empty(version, power, charge):
    floor = Floorplan()
    floor.tell(battery=None, power=None)
    said = floor.said(version)
    assert said[power][charge] == 80.0
    assert "BATTERY_NOT_MEASURED" in [each["infoType"] for each in said["information"]]
    floor.tell(battery=0.0)
    said = floor.said(version)
    assert said[power][charge] == 0.0
    assert "BATTERY_NOT_MEASURED" not in [each["infoType"] for each in said["information"]]


def test_state_has_the_path_as_a_nurbs_from_where_the_robot_is_and_2_1_its_own_words():
    said = driving().said()
    assert said["plannedPath"]["traversedNodes"] == ["b"]
    path = said["plannedPath"]["trajectory"]
    assert path["controlPoints"] == [{"x": 1.5, "y": 1.1}, {"x": 3.0, "y": 1.0}, {"x": 4.0, "y": 1.0}]
    assert len(path["knotVector"]) == len(path["controlPoints"]) + path["degree"] + 1
    assert path["knotVector"] == sorted(path["knotVector"])
    old = driving().said("2.1")
    assert {"plannedPath", "instantActionStates", "powerSupply"}.isdisjoint(old)
    assert (old["agvPosition"]["positionInitialized"], old["batteryState"]["batteryCharge"]) == (True, 50.0)
    assert {each["errorType"] for each in old["errors"]} == {"orderError", "invalidInstantAction", "batteryLow"}


async def test_planned_path_goes_on_from_node_to_node_of_the_base_as_the_planner_would_and_no_farther():
    floor, asked = Floorplan(), []

    class Plans:
        async def ask(self, request: Request) -> Answer:
            asked.append(request.body)
            x, y = (request.body[name]["x"] for name in ("start", "goal"))
            if x == 7.0:
                return Answer("", body={"points": [], "refusal": {"reason": "every path is blocked"}})
            return Answer("", body={"points": [[x, 1.0], [x, 1.5], [x, 2.0], [y, 1.0]], "refusal": None})

    nodes = [A, B, C, node("d", 6, 9.0, 1.0), node("e", 8, 9.0, 5.0, released=False)]
    floor.take(order(*nodes))
    floor.drive()
    floor.robot.on_path([(1.0, 1.0), (4.0, 1.0)])
    link = RobotLink(SETUP, "r1", Plans(), ManualClock())
    link.core = floor.robot
    looking = asyncio.create_task(link.look_loop())
    for _ in range(5):
        await asyncio.sleep(0)
    path = floor.said()["plannedPath"]
    assert path["traversedNodes"] == ["b", "c"], "no path leads from c to d, and e is not released"
    corners = [(each["x"], each["y"]) for each in path["trajectory"]["controlPoints"]]
    assert corners == [(1.0, 1.0), (4.0, 1.0), (4.0, 2.0), (7.0, 1.0)]
    assert [each["start"]["x"] for each in asked] == [4.0, 7.0]
    link.on_floor("area", floor.now)
    assert floor.said()["plannedPath"]["traversedNodes"] == ["b"], "the map has changed"
    looking.cancel()
    await asyncio.gather(looking, return_exceptions=True)


def damaged(rng: random.Random, message: dict[str, Any]) -> bytes:
    """Return a message with a few of its parts lost, replaced or repeated, or with damaged bytes."""
    rubbish = ("null", "true", "-1", str(2**70), "1e300", "0.5", '""', '"NaN"', '"\\u0000"', "[]", "[[]]", '{"x": 1}',
               json.dumps("x" * 300))  # fmt: skip

    def parts(value: Any) -> list[tuple[Any, Any]]:
        keys = value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
        return [(value, key) for key in keys] + [part for key in keys for part in parts(value[key])]

    found = json.loads(json.dumps(message))
    for _ in range(rng.randint(1, 3)):
        if not (places := parts(found)):
            break
        holder, key = rng.choice(places)
        if rng.random() < 0.3:
            del holder[key]
        elif rng.random() < 0.2 and isinstance(holder, list):
            holder += [holder[key]] * rng.choice([1, 3, 200])
        else:
            holder[key] = json.loads(rng.choice(rubbish))
    data = bytearray(json.dumps(found).encode())
    for _ in range(rng.choice([0, 0, 1, 5])):
        data[rng.randrange(len(data))] = rng.randrange(256)
    return bytes(data[: rng.randrange(len(data))] if rng.random() < 0.1 else data)


async def test_damaged_orders_and_actions_are_counted_one_by_one_and_none_ends_anything():
    rng, floor, refused = random.Random(7), driving(), 0
    links = [RobotLink(msgspec.structs.replace(SETUP, version=v), "r1", Planner(), ManualClock()) for v in VERSIONS]
    whole = order(A, B, C, edge={"maximumSpeed": 1.0, "orientation": 0.0}, zoneSetId="z")
    actions = header() | {"actions": [{"actionType": "cancelOrder", "actionId": "a", "blockingType": "NONE",
                                       "actionParameters": [{"key": "orderId", "value": "o1"}]}]}  # fmt: skip
    counter, before = REFUSED.labels("vda5050", "malformed"), REFUSED.labels("vda5050", "malformed")._value.get()
    for link in links:
        link.core = floor.robot
    for n in range(DAMAGED):
        topic, message = ("order", whole) if n % 2 else ("instantActions", actions)
        version, data = rng.randrange(len(VERSIONS)), damaged(rng, message)
        links[version].on_message(f"vda5050/v3/fognav/r1/{topic}", data)
        try:
            found = decoded(topic, data, VERSIONS[version], "r1")
        except MessageError:
            refused += 1
        else:
            if isinstance(found, Order):
                floor.robot.checked(found, floor.now)
        if n % 100 == 0:
            floor.said(), floor.said("2.1")
    assert refused > DAMAGED * 0.6
    assert counter._value.get() - before == refused
    assert len(floor.said()["errors"]) < 12, "the latest of each type"


def test_message_that_is_too_long_is_refused_before_anything_is_looked_for_in_it():
    with pytest.raises(MessageError, match="over the limit") as refused:
        decoded("order", json.dumps(order(A, B, name="o1")).encode() + b" " * MESSAGE_MAX, "3.0", "r1")
    assert refused.value.order == ""


@pytest.mark.parametrize("version", VERSIONS)
def test_what_the_schema_of_orders_refuses_is_refused_but_for_null_in_place_of_what_may_be_left_out(version):
    rng, whole = random.Random(3), order(A, B, C, version=version)
    known = schema(version, "order")
    if version == "3.0":
        known.validate(whole)
    accepted = 0
    for _ in range(min(DAMAGED, 5000)):
        data = damaged(rng, whole)
        try:
            decoded("order", data, version, "r1")
        except MessageError:
            continue
        accepted += 1
        found = json.loads(data)
        lost = [e for e in known.iter_errors(found) if "NodeId" not in e.message and not e.message.startswith("null")]
        assert not lost, (lost[0], data)
    assert accepted


# --- Zones for robots of others ---------------------------------------------------------------------------------------


def drawn(kind: str, shape: dict[str, Any], *, active: bool = True, **more: Any) -> dict[str, Any]:
    return {"id": "z", "kind": kind, "shape": shape, "active": active, "reason": "", **more}


def sets_of(things: dict[str, dict[str, Any]]) -> ZoneSets:
    """Return the sets of a floor with areas and zones by id, in the events of its console."""
    found = ZoneSets("lab", "lab")
    kinds = {name: "zone" if "kind" in value else "area" for name, value in things.items()}
    events = [("hello", {"fresh": True}),
              *((kinds[name], {"id": name, "value": value}) for name, value in things.items()),
              ("ready", {})]  # fmt: skip
    for name, data in events:
        found.on_event(name, data)
    found.update(0.0)
    return found


def told(sets: ZoneSets) -> dict[str, tuple[Any, ...]]:
    assert sets.current is not None
    zones = msgspec.to_builtins(sets.current)["zones"]
    return {each["zoneId"]: (each["zoneType"], each.get("maximumSpeed"), each.get("penaltyFactor")) for each in zones}


def test_hazards_and_zones_become_the_norms_zones_and_expire_at_the_sender():
    circle = {"type": "circle", "centre": [3.0, 3.0], "radius": 1.0}
    bent = {"type": "corridor", "line": [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]], "width": 1.0}
    sets = sets_of({
        "a": area("blocked", 254), "b": area("unknown", 200), "c": area("clear"), "d": area("blocked", 127),
        "e": area("unknown", 254), "f": area(None), "no": drawn("BLOCKED", circle),
        "slow": drawn("SPEED_LIMIT", circle, speed=0.2), "dear": drawn("PENALTY", bent, factor=5.0),
        "off": drawn("BLOCKED", circle, active=False),
    })  # fmt: skip
    expected = {
        "area-a": ("BLOCKED", None, None), "area-b": ("SPEED_LIMIT", 0.15, None), "area-d": ("PENALTY", None, 0.5),
        "area-e": ("BLOCKED", None, None), "area-f": ("SPEED_LIMIT", 0.15, None), "zone-no": ("BLOCKED", None, None),
        "zone-slow": ("SPEED_LIMIT", 0.2, None), "zone-dear-1": ("PENALTY", None, 0.8),
        "zone-dear-2": ("PENALTY", None, 0.8),
    }  # fmt: skip
    assert told(sets) == expected
    first = sets.current
    message = header() | {"zoneSet": msgspec.to_builtins(first)}
    corners = message["zoneSet"]["zones"][5]["vertices"]
    assert all(math.dist((each["x"], each["y"]), (3.0, 3.0)) >= 1.0 for each in corners)
    sets.on_lost()
    sets.update(10.0)
    assert told(sets) == expected | {"area-c": ("SPEED_LIMIT", 0.15, None)}, "nobody confirms that it is clear"
    sets.on_event("ready", {})
    sets.update(20.0)
    assert sets.current == first, "the same content has the same id"
    schema("3.0", "zoneSet").validate(message)


@pytest.mark.parametrize(
    ("measured", "on_map", "zone"),
    [
        (("clear", 0), {"state": "clear", "penalty": 0, "confirmed": True}, ()),
        (("clear", 0), {"state": "clear", "penalty": 0, "confirmed": False}, ("SPEED_LIMIT", 0.15, None)),
        (("clear", 0), {"state": "unknown", "penalty": 0, "confirmed": False}, ("SPEED_LIMIT", 0.15, None)),
        (("clear", 0), {"state": "unknown", "penalty": 254, "confirmed": False}, ("BLOCKED", None, None)),
        (("clear", 0), {"state": "blocked", "penalty": 254, "confirmed": True}, ("BLOCKED", None, None)),
        (("clear", 0), None, ("SPEED_LIMIT", 0.15, None)),
        (("blocked", 254), {"state": "clear", "penalty": 0, "confirmed": True}, ("BLOCKED", None, None)),
        (("blocked", 254), None, ("BLOCKED", None, None)),
        (("unknown", 200), {"state": "clear", "penalty": 0, "confirmed": True}, ("SPEED_LIMIT", 0.15, None)),
    ],
)  # fmt: skip
def test_area_is_free_for_robots_of_others_only_while_the_map_shows_it_clear_and_confirmed(measured, on_map, zone):
    found = sets_of({"a": area(*measured, on_map=on_map)})
    assert told(found) == ({"area-a": zone} if zone else {})


def test_what_blocks_more_is_told_at_once_and_what_clears_a_little_later():
    sets = sets_of({"a": area("clear")})
    empty = sets.current
    sets.on_event("area", {"id": "a", "value": area("blocked", 254)})
    sets.update(0.1)
    blocked = sets.current
    assert blocked != empty
    sets.on_event("area", {"id": "a", "value": area("clear")})
    sets.update(0.2)
    assert sets.current == blocked
    sets.update(2.2)
    assert sets.current == empty


def test_robot_gets_a_set_enables_it_and_deletes_the_earlier_ones_and_what_is_not_seen_is_sent_again():
    user = ZoneUser("fognav-lab-", "lab")

    def robot_has(**sets: str) -> None:
        names = {name.replace("_", "-"): status for name, status in sets.items()}
        user.on_state([ReportedZoneSet(zone_set_id=n, map_id="lab", zone_set_status=s) for n, s in names.items()])

    wanted = "fognav-lab-2"
    assert list(user.steps(wanted, 0.0)) == [], "it is not there"
    user.is_online = True
    robot_has(fognav_lab_1="ENABLED", theirs="DISABLED")
    assert list(user.steps(wanted, 0.0)) == [("zoneSet", wanted)]
    assert list(user.steps(wanted, 1.0)) == []
    assert list(user.steps(wanted, AGAIN_S + 0.1)) == [("zoneSet", wanted)], "it was lost"
    robot_has(fognav_lab_1="ENABLED", fognav_lab_2="DISABLED", theirs="DISABLED")
    assert list(user.steps(wanted, 6.0)) == [("enableZoneSet", wanted)]
    robot_has(fognav_lab_1="DISABLED", fognav_lab_2="ENABLED", theirs="DISABLED")
    assert list(user.steps(wanted, 7.0)) == [("deleteZoneSet", "fognav-lab-1")]
    assert user.problem == ""
    robot_has(fognav_lab_2="DISABLED", theirs="ENABLED")
    assert list(user.steps(wanted, 20.0)) == []
    assert "somebody else has enabled the zone set theirs" in user.problem
    assert list(user.steps("fognav-lab-3", 20.0)) == [("zoneSet", "fognav-lab-3")], "what has changed is told"
    robot_has(fognav_lab_3="ENABLED", fognav_lab_2="DISABLED")
    assert list(user.steps("fognav-lab-2", 20.1)) == [("enableZoneSet", "fognav-lab-2")], "it is as it was before"
    assert list(user.steps("fognav-lab-3", 20.2)) == [("deleteZoneSet", "fognav-lab-2")]
    assert list(user.steps("fognav-lab-2", 20.3)) == [("enableZoneSet", "fognav-lab-2")], "within the time"


# --- At a broker ------------------------------------------------------------------------------------------------------


class Planner:
    """A floor that accepts each mission; its robots stand where they are."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, str]] = []

    async def ask(self, request: Request) -> Answer:
        self.sent.append((request.method, request.path.rpartition("/")[2]))
        return Answer("", body={"goal_id": "g1"} if request.method == "PUT" else {"path": {"refusal": None}})


class Fleet:
    """A fleet control: what it was told last on each topic, and how often."""

    def __init__(self, client: aiomqtt.Client) -> None:
        self.client = client
        self.told: dict[str, list[dict[str, Any]]] = {}

    async def listen(self) -> None:
        async for message in self.client.messages:
            with suppress(ValueError):  # its own malformed ones
                self.told.setdefault(message.topic.value, []).append(json.loads(message.payload))

    def last(self, name: str, robot: str = "fognav/r1") -> dict[str, Any]:
        return (self.told.get(f"vda5050/v3/{robot}/{name}") or [{}])[-1]

    async def send(self, name: str, content: dict[str, Any] | bytes, robot: str = "fognav/r1", **how: Any) -> None:
        data = content if isinstance(content, bytes) else json.dumps(content)
        await self.client.publish(f"vda5050/v3/{robot}/{name}", data, **how)


@asynccontextmanager
async def fleet_of(tmp_path: Path):
    """Run the adapter and a fleet control at a broker with TLS and passwords; yield both, and the floor."""
    site = SecuredSite(tmp_path, "fleet")
    with site.mosquitto() as server:
        broker = Broker.of(server.url, Credentials.read(site.security.credentials(TESTER)))
        bridge = Vda5050Bridge(
            Setup(site="lab", broker=broker, version="3.0", interface="vda5050", manufacturer="fognav", map_id="lab",
                  robots=["r1"], zones=[("kit", "0001")])
        )  # fmt: skip
        floor = Planner()
        running = asyncio.create_task(bridge.run(floor, SystemClock()))
        await asyncio.sleep(0)

        async def live() -> None:
            number = 0
            for name, data in (("hello", {"fresh": True}), ("area", {"id": "a", "value": area("blocked", 254)}),
                               ("ready", {})):  # fmt: skip
                bridge.on_event(name, data)
            pose = {"x": 1.0, "y": 1.0, "theta": 0.0, "v": 0.0, "w": 0.0, "covariance": [0.0] * 9, "radius": 0.17,
                    "height": 0.1, "localized": True}  # fmt: skip
            while True:
                number += 1
                bridge.on_event("pose", {"id": "r1", "value": pose})
                view = {"state": STATE | {"stamp": number}, "goal": None}
                bridge.on_event("robot", {"id": "r1", "value": view})
                await asyncio.sleep(0.2)

        living = asyncio.create_task(live())
        async with broker.client("master", None) as client:
            fleet = Fleet(client)
            await client.subscribe("vda5050/#", 1)
            listening = asyncio.create_task(fleet.listen())
            yield fleet, bridge, floor, broker, running
            tasks = (running, living, listening)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


@pytest.mark.live
async def test_robot_is_online_with_factsheet_and_state_takes_orders_and_says_when_it_is_gone(tmp_path, until):
    async with fleet_of(tmp_path) as (fleet, bridge, floor, broker, running):
        await until(lambda: fleet.last("state").get("operatingMode") == "AUTOMATIC", "it is under the fleet's control")
        assert fleet.last("connection")["connectionState"] == "ONLINE"
        assert fleet.last("factsheet")["typeSpecification"]["navigationTypes"] == ["FREELY_NAVIGATING"]
        await fleet.send("order", order(A, B, name="old"), retain=True)
        await until(lambda: fleet.last("state").get("orderId") == "old", "sent while it is there, it is no old one")
        await until(lambda: ("PUT", "goal") in floor.sent, "it gets a mission")
        assert ("POST", "dry-run") in floor.sent
        await fleet.send("order", b'{"orderId": "broken')
        await until(
            lambda: [each["errorType"] for each in fleet.last("state")["errors"]] == ["VALIDATION_FAILURE"],
            "the fleet hears that its message is malformed",
        )
        # Whoever connects in its name takes its connection away: to the broker it is lost.
        before = len(fleet.told["vda5050/v3/fognav/r1/connection"])
        async with broker.client("fognav-lab-r1", None):

            def words() -> list[str]:
                return [each["connectionState"] for each in fleet.told["vda5050/v3/fognav/r1/connection"][before:]]

            await until(lambda: "CONNECTION_BROKEN" in words(), "its last will is told")
        orders = len(floor.sent)
        await until(lambda: words()[-1:] == ["ONLINE"], "it is back")
        assert [each for each in floor.sent[orders:] if each[0] == "POST"] == [], "the retained order is not taken"
        bridge.on_lost()
        await until(lambda: words()[-1] == "CONNECTION_BROKEN", "nobody knows where it is")
        running.cancel()
        await until(lambda: words()[-1] == "OFFLINE", "it was ended in good order")


async def test_broker_that_refuses_the_subscription_to_orders_is_a_problem(until):
    told: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(asyncio.IncompleteReadError):
            while True:
                kind, length = await reader.readexactly(2)
                if length > 127:  # the next byte has the rest of it
                    length += ((await reader.readexactly(1))[0] - 1) * 128
                content = await reader.readexactly(length)
                if kind == 0x10:
                    writer.write(b"\x20\x02\0\0")
                elif kind == 0x82:
                    writer.write(b"\x90\x04" + content[:2] + b"\0\x80")
                else:
                    told.append(content)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    broker = Broker.of(f"mqtt://127.0.0.1:{server.sockets[0].getsockname()[1]}")
    bridge = Vda5050Bridge(Setup(site="lab", broker=broker, version="3.0", interface="vda5050", manufacturer="fognav",
                                 map_id="lab", robots=["r1"], zones=[]))  # fmt: skip
    running = asyncio.create_task(bridge.run(Planner(), SystemClock()))
    await until(
        lambda: "vda5050/v3/fognav/r1/instantActions: allow" in bridge.problem, "it is told", lambda: bridge.problem
    )
    assert {*told} <= {b""}, "nothing but that it leaves again"
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    server.close()


@pytest.mark.live
async def test_robot_of_others_gets_the_zones_when_it_comes(tmp_path, until):
    async with fleet_of(tmp_path) as (fleet, bridge, _floor, _broker, _running):
        await until(lambda: "kit/0001" in bridge.problem, "what is missing is said", lambda: bridge.problem)
        await fleet.send("connection", {"connectionState": "ONLINE"}, "kit/0001", qos=1, retain=True)
        await fleet.send("state", b"[", "kit/0001")
        await fleet.send("state", {"zoneSets": []}, "kit/0001")
        await until(lambda: fleet.last("zoneSet", "kit/0001"), "the set is sent")
        found = fleet.last("zoneSet", "kit/0001")["zoneSet"]
        assert [(each["zoneId"], each["zoneType"]) for each in found["zones"]] == [("area-a", "BLOCKED")]
        for status, step in (("DISABLED", "enableZoneSet"), ("ENABLED", "")):
            sets = [{"zoneSetId": found["zoneSetId"], "mapId": "lab", "zoneSetStatus": status}]
            await fleet.send("state", {"zoneSets": sets}, "kit/0001")
            if step:
                await until(lambda: fleet.last("instantActions", "kit/0001"), "it is enabled")
                assert fleet.last("instantActions", "kit/0001")["actions"][0]["actionType"] == step
        await until(lambda: bridge.problem == "", "all is well", lambda: bridge.problem)
