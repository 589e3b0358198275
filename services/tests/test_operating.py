"""What an operator sees before and after a change, against all running services and one robot's messages."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import httpx
import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import RobotPose, RobotState

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.live

SERVICES = ("hazard_aggregator", "map_service", "planner")
HANDLED = {
    "hazard_aggregator": (ch.NODE_READING, ch.ROBOT_POSE, ch.LEADER),
    "map_service": (ch.AREA_HAZARD, ch.ROBOT_STATE, ch.LEADER),
    "planner": (ch.MAP_DELTA, ch.ROBOT_POSE, ch.PLANNER_PLAN),
}
"""Of each service some channels whose messages or queries it handles, over MQTT and zenoh."""


class Operator:
    """Sends requests to the service that has the route; the robot reports the map version `applied`."""

    def __init__(self, client: httpx.AsyncClient, urls: dict[str, str], tokens: dict[str, dict[str, str]]) -> None:
        self._client = client
        self._urls = urls
        self._tokens = tokens
        self.applied = (0, 0)

    async def ask(
        self, method: str, path: str, body: object = None, *, role: str = "operator", **headers: str
    ) -> httpx.Response:
        part = path.split("/")[3].partition("?")[0]
        planner = dict.fromkeys(("robots", "plan", "schedules"), "planner")
        service = {"areas": "hazard_aggregator", **planner}.get(part, "map_service")
        url = f"{self._urls[service]}{path}"
        return await self._client.request(method, url, json=body, headers={**self._tokens[role], **headers})


@pytest.fixture
async def operator(all_services, tokens) -> AsyncIterator[Operator]:
    urls = {service: await all_services.ready(service) for service in SERVICES}
    async with all_services.edges() as (_, zenoh, _), httpx.AsyncClient(timeout=60.0) as client:
        made = Operator(client, urls, tokens)
        async with robot(zenoh, made):
            async with asyncio.timeout(60):
                while (  # noqa: ASYNC110  # another process changes it
                    await made.ask("POST", "/api/v1/robots/r1/goal/dry-run", place(7.0))
                ).status_code != 200:
                    await asyncio.sleep(0.05)
            yield made


@asynccontextmanager
async def robot(zenoh, operator: Operator) -> AsyncIterator[None]:
    """Publish what a robot says that stands at (1, 3)."""
    pose = RobotPose(
        x=1.0, y=3.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.3, stamp=0.0
    )  # fmt: skip

    async def publish() -> None:
        while True:
            epoch, seq = operator.applied
            state = RobotState(
                mode="HOLD", reasons=[], enabled=False, battery=None, goal_id=None, map_epoch=epoch, map_seq=seq,
                plan_id=None,
            )  # fmt: skip
            zenoh.publish(ch.ROBOT_POSE, pose, robot="r1")
            zenoh.publish(ch.ROBOT_STATE, state, robot="r1")
            await asyncio.sleep(0.1)

    publishing = asyncio.create_task(publish())
    try:
        yield
    finally:
        publishing.cancel()


def place(x: float, y: float = 3.0) -> dict[str, object]:
    return {"pose": {"x": x, "y": y}}


def rectangle(left: float, bottom: float, right: float, top: float, **more: object) -> dict[str, object]:
    shape = {"type": "rectangle", "corner": [left, bottom], "opposite": [right, top]}
    return {"kind": "BLOCKED", "shape": shape, **more}


async def test_first_metrics_of_a_service_let_alerts_see_its_first_bug_and_tell_of_its_own_backup_only(all_services):
    async with httpx.AsyncClient(timeout=60.0) as client:
        for service in SERVICES:
            lines = (await client.get(f"{await all_services.ready(service)}/metrics")).text.splitlines()
            # An increase is seen of what was 0 before only.
            for channel in HANDLED[service]:
                assert f'fognav_handler_errors_total{{channel="{channel.name}"}} 0.0' in lines
            backups = [line.split()[-1] for line in lines if line.startswith("fognav_last_backup_seconds")]
            assert backups == (["0.0"] if service == "map_service" else [])


async def test_dry_runs_by_rest_tell_of_a_robot_what_a_zone_would_do_to_its_way_and_where_a_goal_leads(operator):
    goal = (await operator.ask("POST", "/api/v1/robots/r1/goal/dry-run", place(7.0), role="viewer")).json()
    assert goal["path"]["length_m"] >= 6.0
    assert goal["path"]["seconds"] >= 20.0
    assert goal["points"][0] == pytest.approx([1.0, 3.0])
    assert (await operator.ask("PUT", "/api/v1/robots/r1/goal", place(7.0))).status_code == 201
    body = {"zones": [rectangle(5.0, 0.0, 5.4, 6.0, id="wall")]}
    async with asyncio.timeout(60):
        while True:
            answer = await operator.ask("POST", "/api/v1/dry-run", body, role="viewer")
            assert answer.status_code == 200, answer.text
            robots = answer.json()["robots"]
            if robots and robots[0]["before"]:
                break
            await asyncio.sleep(0.05)  # until the planner has planned
    assert robots[0]["before"]["length_m"] >= 6.0
    assert robots[0]["after"]["refusal"]["kind"] == "cut_by_places"
    assert robots[0]["after"]["refusal"]["causes"] == [{"kind": "zone", "id": "wall", "state": "BLOCKED"}]
    assert (await operator.ask("GET", "/api/v1/zones")).json()["zones"] == []
    closed = await operator.ask("POST", "/api/v1/dry-run", {"overrides": {"hall": "blocked"}})
    assert closed.json()["robots"][0]["extra_m"] > 0.0
    assert (await operator.ask("DELETE", "/api/v1/robots/r1/goal")).status_code == 204


async def test_dry_run_names_what_is_wrong_with_its_request(operator):
    for body, field in (
        ({"zones": [rectangle(90.0, 90.0, 91.0, 91.0)]}, "body.zones.0.shape"),
        ({"removed_zones": ["none"]}, "body.removed_zones.0"),
        ({"sets": {"none": True}}, "body.sets.none"),
        ({"overrides": {"none": "blocked"}}, "body.overrides.none"),
    ):
        answer = await operator.ask("POST", "/api/v1/dry-run", body)
        assert (answer.status_code, answer.json()["errors"][0]["field"]) == (422, field)
    unknown = await operator.ask("POST", "/api/v1/robots/r9/goal/dry-run", place(7.0))
    assert unknown.status_code == 404


async def test_second_dry_run_of_a_caller_is_refused_while_the_first_is_computed(operator):
    zones = [rectangle(0.1, 0.1, 7.9, 5.9, id=f"z{number}") for number in range(40)]
    answers = await asyncio.gather(
        *(
            operator.ask("POST", "/api/v1/dry-run", {"zones": zones}, role=role)
            for role in ("viewer", "viewer", "admin")
        )
    )
    assert sorted(answer.status_code for answer in answers) == [200, 200, 503]
    refused = next(answer for answer in answers if answer.status_code == 503)
    assert refused.headers["retry-after"] == "1"


async def latest_entry(operator: Operator, kind: str) -> dict:
    return (await operator.ask("GET", f"/api/v1/audit?kind={kind}&limit=1")).json()[0]


async def undo(operator: Operator, path: str, kind: str, **options: str) -> httpx.Response:
    """Undo the latest change of a kind."""
    entry = (await latest_entry(operator, kind))["entry"]
    return await operator.ask("POST", f"{path}/undo", {"entry": entry}, **options)


async def test_zone_is_undone_and_redone_from_its_creation_to_its_deletion(operator):
    path, wet, slow = "/api/v1/zones/wet", rectangle(1.0, 1.0, 2.0, 2.0), rectangle(1.0, 1.0, 3.0, 3.0, reason="mop")
    assert (await operator.ask("PUT", path, wet, **{"If-None-Match": "*"})).status_code == 201
    assert (await undo(operator, path, "zone")).json() == {"kind": "zone", "id": "wet", "value": None}
    assert (await operator.ask("GET", path)).status_code == 404
    assert (await undo(operator, path, "zone")).json()["value"]["id"] == "wet", "redone"
    assert (await operator.ask("PUT", path, slow)).status_code == 200
    assert (await undo(operator, path, "zone")).status_code == 200
    assert (await operator.ask("GET", path)).json()["shape"]["opposite"] == [2.0, 2.0]
    assert (await undo(operator, path, "zone")).json()["value"]["reason"] == "mop"
    assert (await operator.ask("DELETE", path)).status_code == 204
    assert (await undo(operator, path, "zone")).json()["value"]["reason"] == "mop"
    entry = await latest_entry(operator, "zone")
    assert (entry["who"], entry["action"], entry["before"]) == ("anna", "undo", None)
    assert (await operator.ask("DELETE", path)).status_code == 204


async def test_undo_is_refused_once_somebody_else_has_changed_the_zone_and_names_who(operator):
    path = "/api/v1/zones/edge"
    assert (await operator.ask("PUT", path, rectangle(1.0, 1.0, 2.0, 2.0), **{"If-None-Match": "*"})).status_code == 201
    mine = (await latest_entry(operator, "zone"))["entry"]
    assert (await operator.ask("PUT", path, rectangle(1.0, 1.0, 2.0, 2.5), role="admin")).status_code == 200
    refused = await operator.ask("POST", f"{path}/undo", {"entry": mine})
    problem = refused.json()
    assert (refused.status_code, problem["type"], problem["by"]) == (409, "urn:fognav:changed_since", "ada")
    assert "ada has changed edge since (replace, " in problem["detail"]
    later = await operator.ask("POST", f"{path}/undo", {"entry": problem["entry"]})
    assert later.status_code == 200
    assert (await operator.ask("POST", f"{path}/undo", {"entry": mine})).json()["by"] == "anna", "by the undo itself"
    assert (await operator.ask("POST", "/api/v1/zones/other/undo", {"entry": mine})).status_code == 422
    assert (await operator.ask("POST", f"{path}/undo", {"entry": mine}, role="viewer")).status_code == 403
    assert (await operator.ask("DELETE", path)).status_code == 204


async def test_zone_with_a_time_to_live_comes_back_with_the_rest_of_it(operator):
    path = "/api/v1/zones/short"
    body = rectangle(1.0, 1.0, 2.0, 2.0, ttl_s=600.0)
    made = (await operator.ask("PUT", path, body, **{"If-None-Match": "*"})).json()
    assert (await operator.ask("DELETE", path)).status_code == 204
    back = (await undo(operator, path, "zone")).json()["value"]
    assert back["ttl_s"] < 600.0
    assert back["expires_at"] == made["expires_at"]
    assert (await operator.ask("DELETE", path)).status_code == 204


async def test_override_of_an_area_and_the_area_itself_are_undone(operator):
    path = "/api/v1/areas/hall"
    first, second = ({"state": state, "reason": "test", "ttl_s": 600.0} for state in ("blocked", "clear"))
    assert (await operator.ask("PUT", f"{path}/override", first)).status_code == 201
    assert (await operator.ask("PUT", f"{path}/override", second, role="admin")).status_code == 200
    back = (await undo(operator, path, "override")).json()["value"]
    assert (back["state"], back["author"]) == ("blocked", "anna")
    assert back["ttl_s"] <= 600.0
    refused = await undo(operator, path, "override")
    assert refused.json()["type"] == "urn:fognav:clear_needs_admin", "to redo declares the area clear"
    assert (await operator.ask("DELETE", f"{path}/override")).status_code == 204
    assert (await undo(operator, path, "override")).json()["value"]["state"] == "blocked"
    assert (await undo(operator, path, "override")).json()["value"] is None, "redone"
    area = (await operator.ask("GET", path)).json()["definition"]
    changed = {"polygon": area["polygon"], "nodes": area["nodes"], "label": "the other hall"}
    assert (await operator.ask("PUT", path, changed)).status_code == 200
    assert (await undo(operator, path, "area")).json()["value"]["label"] == "the hall"
    assert (await operator.ask("PUT", "/api/v1/areas/new", changed)).status_code == 201
    assert (await undo(operator, "/api/v1/areas/new", "area")).json()["value"] is None
    assert (await operator.ask("GET", "/api/v1/areas/new")).status_code == 404
    assert (await undo(operator, "/api/v1/areas/new", "area")).json()["value"]["label"] == "the other hall"


async def test_missions_are_undone_and_commands_are_not(operator):
    path = "/api/v1/robots/r1"
    assert (await operator.ask("PUT", f"{path}/goal", place(3.0))).status_code == 201
    assert (await operator.ask("PUT", f"{path}/goal", place(6.0))).status_code == 200
    assert (await undo(operator, path, "mission")).json()["value"]["goal"]["pose"]["x"] == 3.0
    assert (await operator.ask("GET", f"{path}/goal")).json()["pose"]["x"] == 3.0
    assert (await operator.ask("DELETE", f"{path}/goal")).status_code == 204
    assert (await undo(operator, path, "mission")).status_code == 200
    assert (await operator.ask("GET", f"{path}/goal")).json()["pose"]["x"] == 3.0
    assert (await undo(operator, path, "mission")).json()["value"] is None, "redone"
    await operator.ask("POST", f"{path}/stop")  # nobody answers it, but it is recorded
    refused = await undo(operator, path, "stop")
    assert (refused.status_code, refused.json()["type"]) == (409, "urn:fognav:not_undoable")
    assert "commands can't be undone" in refused.json()["detail"]


async def test_change_is_applied_by_a_robot_once_that_reports_a_map_which_contains_it(operator):
    body = rectangle(5.0, 1.0, 5.5, 1.5, id="seen")
    assert (await operator.ask("POST", "/api/v1/zones", body)).status_code == 201

    async def robots() -> tuple[dict, dict]:
        change = (await operator.ask("GET", "/api/v1/applied?kind=zone&id=seen", role="viewer")).json()[0]
        return change, {robot["robot"]: robot for robot in change["robots"]}

    change, found = await robots()
    assert (change["state"], found["r1"]["applied"], found["r1"]["since"]) == ("active", False, change["at"])
    operator.applied = change["epoch"], change["seq"]
    async with asyncio.timeout(60):
        while not (await robots())[1]["r1"]["applied"]:  # noqa: ASYNC110  # another process changes it
            await asyncio.sleep(0.05)
    assert (await robots())[1]["r1"]["since"] >= change["at"]
    assert (await operator.ask("DELETE", "/api/v1/zones/seen")).status_code == 204
    change, found = await robots()
    assert (change["state"], found["r1"]["applied"]) == ("removed", False)


async def test_zones_leave_and_come_back_as_geojson(operator):
    shapes = [
        {"type": "rectangle", "corner": [1.0, 1.0], "opposite": [2.0, 2.5]},
        {"type": "polygon", "points": [[1.0, 1.0], [2.0, 1.0], [1.5, 2.0]]},
        {"type": "circle", "centre": [6.0, 1.5], "radius": 0.5},
        {"type": "corridor", "line": [[5.0, 5.0], [6.0, 5.0]], "width": 0.4},
    ]
    for number, shape in enumerate(shapes):
        body = {"kind": "PENALTY", "factor": 2.0, "shape": shape, "id": f"g{number}", "reason": "<b>wet</b>"}
        body |= {"ttl_s": 900.0} if number == 3 else {}
        assert (await operator.ask("POST", "/api/v1/zones", body)).status_code == 201
    answer = await operator.ask("GET", "/api/v1/zones.geojson")
    assert answer.headers["content-type"] == "application/geo+json"
    collection, before = answer.json(), (await operator.ask("GET", "/api/v1/zones")).json()["zones"]
    assert collection["fognav"] == {"site": "test", "frame": "map", "unit": "m"}
    same = await operator.ask("POST", "/api/v1/zones.geojson", collection)
    assert {zone["outcome"] for zone in same.json()} == {"unchanged"}
    for zone in before:
        assert (await operator.ask("DELETE", f"/api/v1/zones/{zone['id']}")).status_code == 204
    added = await operator.ask("POST", "/api/v1/zones.geojson", collection)
    assert {zone["outcome"] for zone in added.json()} == {"added"}
    after = (await operator.ask("GET", "/api/v1/zones")).json()["zones"]
    ours = {"version": 0, "ttl_s": None}
    assert [{**zone, **ours} for zone in after] == [{**zone, **ours} for zone in before]
    collection["features"][0]["properties"]["reason"] = "dry"
    changed = await operator.ask("POST", "/api/v1/zones.geojson", collection)
    assert [zone["outcome"] for zone in changed.json()] == ["replaced", "unchanged", "unchanged", "unchanged"]


async def test_geojson_with_wrong_features_changes_nothing_and_names_each_of_them(operator):
    def feature(geometry: object, **properties: object) -> dict[str, object]:
        return {"type": "Feature", "geometry": geometry, "properties": {"kind": "BLOCKED", **properties}}

    ring = [[1.0, 1.0], [2.0, 1.0], [2.0, 2.0], [1.0, 1.0]]
    features = [
        feature({"type": "Polygon", "coordinates": [ring]}, id="fine"),
        feature({"type": "Polygon", "coordinates": [ring, ring]}),
        feature({"type": "Point", "coordinates": [1.0, 1.0]}),
        feature({"type": "Polygon", "coordinates": [ring]}, kind="PENALTY", factor=9),
        feature({"type": "Polygon", "coordinates": [[[-9.1, 38.7], [-9.0, 38.7], [-9.0, 38.8], [-9.1, 38.7]]]}),
        feature({"type": "Polygon", "coordinates": [ring]}, id="No Id"),
        feature({"type": "LineString", "coordinates": [[1.0, 1.0]]}, width=1.0),
    ]
    before = (await operator.ask("GET", "/api/v1/zones")).json()["zones"]
    answer = await operator.ask("POST", "/api/v1/zones.geojson", {"type": "FeatureCollection", "features": features})
    assert answer.status_code == 422, answer.text
    errors = {error["field"]: error["problem"] for error in answer.json()["errors"]}
    assert list(errors) == [
        "body.features.1.geometry", "body.features.2.properties.radius", "body.features.3.properties.factor",
        "body.features.4.geometry", "body.features.5.id", "body.features.6.geometry",
    ]  # fmt: skip
    assert "not longitude and latitude" in errors["body.features.4.geometry"]
    assert (await operator.ask("GET", "/api/v1/zones")).json()["zones"] == before
    unknown = feature({"type": "MultiPoint", "coordinates": []})
    answer = await operator.ask("POST", "/api/v1/zones.geojson", {"type": "FeatureCollection", "features": [unknown]})
    assert answer.json()["errors"][0]["field"] == "body.features.0.geometry.type"


async def test_operator_schedules_a_mission_which_is_kept_and_starts_nothing_at_once(operator):
    times = [{"days": ["mon", "tue", "wed", "thu", "fri", "sat", "sun"], "begin": "00:00", "end": "23:59"}]
    mission = {"stops": [place(7.0)], "when_cut": {"do": "nearest"}}
    body = {"robot": "r1", "mission": mission, "weekly": {"time_zone": "Europe/Lisbon", "times": times}}
    path = "/api/v1/schedules/round"
    for change, field in (
        ({"robot": "r9"}, None),
        ({"mission": {"stops": [{"place": "nowhere"}]}}, "body.mission.stops.0.place"),
        ({"weekly": {"time_zone": "Europe/Atlantis", "times": times}}, "body.weekly.time_zone"),
        ({"weekly": {"time_zone": "UTC", "times": [{**times[0], "end": "00:00"}]}}, "body.weekly.times"),
        ({"mission": {"stops": 9 * [place(7.0)], "order": "best"}}, "body.mission.order"),
    ):
        answer = await operator.ask("PUT", path, {**body, **change})
        assert answer.status_code in (404, 422), answer.text
        assert field is None or field in answer.text
    assert (await operator.ask("PUT", path, body, role="viewer")).status_code == 403
    made = await operator.ask("PUT", path, body, **{"If-None-Match": "*"})
    assert (made.status_code, made.json()["last"], made.json()["waits"]) == (201, None, "")
    assert made.json()["next"] is None or made.json()["next"] > made.json()["since"], "None: no synchronized clock"
    assert (await operator.ask("PUT", path, body, **{"If-None-Match": "*"})).status_code == 412
    changed = await operator.ask("PUT", path, {**body, "enabled": False}, **{"If-Match": made.headers["etag"]})
    assert (changed.status_code, changed.json()["next"]) == (200, None)
    assert (await operator.ask("PUT", path, body, **{"If-Match": made.headers["etag"]})).status_code == 412
    (listed,) = (await operator.ask("GET", "/api/v1/schedules", role="viewer")).json()
    assert (listed["id"], listed["mission"], listed["enabled"]) == ("round", made.json()["mission"], False)
    assert (await operator.ask("GET", "/api/v1/robots/r1/goal", role="viewer")).status_code == 404, "nothing has begun"
    assert (await operator.ask("DELETE", path)).status_code == 204
    assert (await operator.ask("GET", path, role="viewer")).status_code == 404
