"""Alerts: raised when a condition lasts as long as the area's policy allows, ended with it, acknowledged by people."""

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client import REGISTRY
from redis.asyncio import Redis

from fog_contracts import channels as ch
from fog_contracts.codec import encode
from fog_contracts.handlers import Moment, Publication
from fog_contracts.messages import (
    Alert,
    AlertList,
    AlertPolicy,
    AreaDefinition,
    AreaHazard,
    HazardOverride,
    NodeCode,
    Reason,
)
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Audit
from fog_supervisor.servers import start_redis
from hazard_aggregator.alert_persistence import AlertPersistence, NodeMetrics
from hazard_aggregator.alerts import LISTED, AlertError, Alerts, NodeReport
from hazard_aggregator.store import Store, Stored

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
POLICY = AlertPolicy(unknown_after_s=10.0, blocked_after_s=20.0, node_after_s=5.0)
OVERRIDE = HazardOverride(
    state="blocked", author="ann", reason="wax", set_at=1.0, ttl_s=9.0, measured="clear", measured_penalty=0
)


def hazard(state, **fields) -> AreaHazard:
    values = {"severity": 0, "penalty": 0, "since": 1.0, "seq": 1, "epoch": 1, "cause": f"it is {state}", **fields}
    return AreaHazard(area="hall", state=state, **values)


def report(state, penalty=None, code=NodeCode.FLAPS) -> NodeReport:
    reason = Reason(code, code.says)
    return NodeReport("n1", "hall", state, reason, online=True, age=0.1, received=9, ignored=0, penalty=penalty)


class Rig:
    def __init__(self, policy=POLICY) -> None:
        self.definition = AreaDefinition(id="hall", polygon=SQUARE, alerts=policy)
        self.alerts = Alerts()
        self.now = 100.0

    def step(self, area: AreaHazard, *reports: NodeReport, seconds: float = 1.0) -> list[str]:
        """Return what happened at the end of this time."""
        self.now += seconds
        at = Moment(self.now, 1e9 + self.now)
        events = self.alerts.update([self.definition], {"hall": area}, reports, at)
        return [f"{event.action} {event.alert.id}" for event in events]


def test_area_that_is_unknown_or_blocked_for_long_is_an_alert_until_it_is_clear():
    rig = Rig()
    assert rig.step(hazard("unknown")) == []
    assert rig.step(hazard("unknown"), seconds=9.9) == []
    assert rig.step(hazard("unknown")) == ["raise area-unknown.hall"]
    (alert,) = rig.alerts.active()
    assert (alert.reason, alert.raised - alert.since) == ("it is unknown", pytest.approx(10.9))
    assert rig.step(hazard("blocked")) == ["end area-unknown.hall"]
    assert rig.step(hazard("blocked"), seconds=20.0) == ["raise area-blocked.hall"]
    assert rig.step(hazard("clear")) == ["end area-blocked.hall"]
    assert rig.step(hazard("blocked")) == [], "it needs the whole time again"


def test_node_that_is_unknown_is_an_alert_with_its_newest_reason():
    rig = Rig()
    rig.step(hazard("clear"), report("unknown", code=NodeCode.SILENT))
    raised = rig.step(hazard("clear"), report("unknown", code=NodeCode.OFFLINE), seconds=5.0)
    assert raised == ["raise node-unknown.hall.n1"]
    assert rig.step(hazard("clear"), report("unknown", code=NodeCode.FLAPS)) == []
    assert [(alert.code, alert.reason) for alert in rig.alerts.active()] == [("flaps", "it changes too often")]
    assert rig.step(hazard("clear"), report("clear")) == ["end node-unknown.hall.n1"]


def test_area_that_an_operator_overrides_or_a_sensor_makes_costly_is_not_called_unknown():
    rig = Rig()
    for seconds in (0.0, 100.0):
        assert rig.step(hazard("unknown", override=OVERRIDE), seconds=seconds) == []
        assert rig.step(hazard("blocked", override=OVERRIDE), seconds=seconds) == []
        assert rig.step(hazard("unknown"), report("blocked", penalty=120), seconds=seconds) == []


def test_policy_of_zero_seconds_never_alerts():
    rig = Rig(AlertPolicy(unknown_after_s=0, blocked_after_s=0, node_after_s=0))
    for state in ("unknown", "blocked"):
        rig.step(hazard(state), report("unknown"))
        assert rig.step(hazard(state), report("unknown"), seconds=1e6) == []


def test_alert_of_an_area_that_is_removed_ends():
    rig = Rig()
    rig.step(hazard("blocked"))
    assert rig.step(hazard("blocked"), seconds=20.0) == ["raise area-blocked.hall"]
    events = rig.alerts.update([], {"hall": hazard("blocked")}, [report("unknown")], Moment(500.0, 500.0))
    assert [event.action for event in events] == ["end"]


def test_restored_alert_keeps_its_acknowledgement_and_is_not_raised_again():
    rig = Rig()
    rig.step(hazard("blocked"))
    rig.step(hazard("blocked"), seconds=20.0)
    rig.alerts.accept(rig.alerts.acknowledgement("area-blocked.hall", "ann", 7.0).alert)
    after = Rig()
    after.alerts.restore(rig.alerts.active())
    assert after.step(hazard("blocked")) == []
    assert [alert.acknowledged_by for alert in after.alerts.active()] == ["ann"]
    assert after.step(hazard("clear")) == ["end area-blocked.hall"]
    with pytest.raises(AlertError, match="there is no alert"):
        after.alerts.acknowledgement("area-blocked.hall", "ann", 8.0)


def test_message_of_very_many_alerts_fits_its_channel_and_lists_unseen_ones_first():
    alerts = Alerts()
    wide = "\N{GRINNING FACE}"
    alerts.restore(
        Alert(
            id=f"node-unknown.{'a' * 32}.{number:032}", kind="node-unknown", area="a" * 32, node=f"{number:032}",
            reason=wide * 200, since=9e9 + 0.123456, raised=float(number), acknowledged_at=9e9 + 0.123456,
            code=max(NodeCode, key=len), acknowledged_by=None if number == 499 else wide * 100,
        )
        for number in range(500)
    )  # fmt: skip
    message = alerts.message(2**53)
    encode(ch.AGGREGATOR_ALERTS, message)
    assert (message.total, message.unseen, len(message.alerts)) == (500, 1, LISTED)
    assert message.alerts[0].node == f"{499:032}"


@given(st.lists(st.tuples(st.sampled_from(["clear", "blocked", "unknown"]), st.floats(0.1, 30.0)), max_size=40))
def test_alerts_are_exactly_the_conditions_that_last(steps):
    rig, state, lasted = Rig(), None, 0.0
    limits = {"unknown": 10.0, "blocked": 20.0}
    active: set[str] = set()
    for new, seconds in steps:
        lasted = lasted + seconds if new == state else 0.0
        state = new
        for event in rig.step(hazard(state), seconds=seconds):
            action, name = event.split()
            assert (name in active) == (action == "end")
            active ^= {name}
        assert active == ({f"area-{state}.hall"} if lasted >= limits.get(state, 1e9) - 1e-6 else set()) or (
            state in limits and abs(lasted - limits[state]) < 1e-6
        )


POLYGON = [[1.0, 1.0], [2.0, 1.0], [2.0, 2.0], [1.0, 2.0]]


@pytest.mark.live
async def test_alert_is_published_acknowledged_kept_over_a_kill_and_in_the_audit_trail(fog, until, tokens):
    fog.start("hazard_aggregator")
    url = await fog.ready("hazard_aggregator")
    heard: list[AlertList] = []
    async with fog.edges() as (mqtt, _, connect), httpx.AsyncClient(timeout=60) as client:
        mqtt.on(ch.AGGREGATOR_ALERTS, lambda _, message: heard.append(message), AlertList)
        connect()
        await mqtt.wait_connected()
        body = {"polygon": POLYGON, "nodes": ["n1"], "alerts": {"unknown_after_s": 1.0, "node_after_s": 0}}
        put = await client.put(f"{url}/api/v1/areas/hall", json=body, headers=tokens["operator"])
        assert put.status_code == 200, put.text
        await until(lambda: heard and heard[-1].unseen == 1, "alert", lambda: fog.log("hazard_aggregator"))
        (alert,) = (await client.get(f"{url}/api/v1/alerts")).json()
        assert (alert["id"], alert["acknowledged_by"]) == ("area-unknown.hall", None)
        path = f"/api/v1/alerts/{alert['id']}/acknowledgement"
        assert (await client.put(url + path)).status_code == 401
        assert (await client.put(f"{url}{path}x", headers=tokens["operator"])).status_code == 404
        seen = await client.put(url + path, headers=tokens["operator"])
        assert (seen.status_code, seen.json()["acknowledged_by"]) == (200, "anna"), seen.text
        await until(lambda: (heard[-1].total, heard[-1].unseen) == (1, 0), "acknowledged")
        assert 'fognav_alerts{kind="area-unknown",seen="true"} 1.0' in (await client.get(f"{url}/metrics")).text
        epoch = heard[-1].epoch
        fog.kill("hazard_aggregator")
        fog.start("hazard_aggregator")
        url = await fog.ready("hazard_aggregator")
        await until(
            lambda: heard[-1].epoch > epoch and (heard[-1].total, heard[-1].unseen) == (1, 0),
            "kept",
            lambda: fog.log("hazard_aggregator"),
        )
        removal = {**body, "removed": True}
        assert (await client.put(f"{url}/api/v1/areas/hall", json=removal, headers=tokens["operator"])).is_success
        await until(lambda: heard[-1].total == 0, "ended")
    async with fog.raw_redis() as redis, asyncio.timeout(60):
        actions: list[bytes] = []
        while len(actions) < 3:
            actions = [entry[b"action"] for _, entry in await redis.xrange("fog:test:audit:alert")]
            await asyncio.sleep(0.05)
    assert actions == [b"raise", b"acknowledge", b"end"]


def node_report(node, state="clear", age=0.1, *, flapping=False) -> NodeReport:
    reason = Reason(NodeCode.REPORTED, "")
    return NodeReport(node, "hall", state, reason, online=True, age=age, received=9, ignored=0, flapping=flapping)


def metric(name: str, node: str) -> float | None:
    return REGISTRY.get_sample_value(f"fognav_node_{name}", {"area": "hall", "node": node})


@pytest.fixture
def metrics():
    shown = NodeMetrics()
    yield shown
    shown.show(())


@pytest.mark.live
async def test_acknowledgements_are_stored_and_in_the_audit_trail_once_before_they_are_published(tmp_path, monkeypatch):
    async def fell_silent(_alerts: list[Alert]) -> None:
        raise StoreError("Redis does not answer")

    rig = Rig()
    for seconds in (1.0, 20.0):
        rig.step(hazard("blocked"), report("unknown"), seconds=seconds)
    published: list[Publication] = []
    edges = SimpleNamespace(now=lambda: Moment(1.0, 1.0), publish=published.append)
    with start_redis(tmp_path) as redis:
        async with Store(redis.url, "test", service="hazard-aggregator") as store:
            await store.save_alerts(rig.alerts.active())
            core = cast("Any", SimpleNamespace(epoch=1))
            alerts = AlertPersistence(core, store, cast("Any", edges), cast("Any", None), asyncio.Event())
            await alerts._load()
            names = [alert.id for alert in alerts.active()]
            assert len(names) == 2
            await asyncio.gather(*(alerts.acknowledge(name, "ann") for name in names))
            trail = (await store.audit(kinds=["alert"])).entries
            assert sorted(entry.id for entry in trail) == sorted(names)
            assert [alert.acknowledged_by for alert in await store.alerts()] == ["ann", "ann"]

            published.clear()
            with monkeypatch.context() as silent:
                silent.setattr(store, "save_alerts", fell_silent)
                with pytest.raises(StoreError):
                    await alerts.acknowledge(names[0], "bob")
            assert not published
            assert [alert.acknowledged_by for alert in alerts.active()] == ["ann", "ann"]
            await alerts.acknowledge(names[0], "bob")
            assert sorted(str(alert.acknowledged_by) for alert in await store.alerts()) == ["ann", "bob"]
            assert len((await store.audit(kinds=["alert"])).entries) == len(trail) + 1

            async with Redis.from_url(redis.url) as raw:
                await raw.flushall()
            await store.restore(Stored([], [], [], {}, {}), Audit(1.0, "eve", "restore"))
            await alerts._write()
            assert len(await store.alerts()) == 2, "acknowledgements outlast a loss that an administrator mends"


def test_node_is_unknown_silent_or_flapping(metrics):
    metrics.show([node_report("n1"), node_report("n2", "unknown", 40.0), node_report("n3", "unknown", flapping=True)])
    found = [[metric(name, node) for name in ("unknown", "silence_seconds", "flapping")] for node in ("n1", "n2", "n3")]
    assert found == [[0, 0.1, 0], [1, 40.0, 0], [1, 0.1, 1]]


def test_node_without_a_reading_has_no_silence(metrics):
    metrics.show([node_report("n1", "unknown", None)])
    assert (metric("unknown", "n1"), metric("silence_seconds", "n1")) == (1, None)
    metrics.show(())
    assert metric("unknown", "n1") is None


def test_node_without_a_reading_since_its_definition_changed_has_no_silence_any_more(metrics):
    metrics.show([node_report("n1", age=0.1), node_report("n2", age=0.2)])
    for _ in range(2):
        metrics.show([node_report("n1", "unknown", None), node_report("n2", age=0.3)])
        assert [metric("silence_seconds", node) for node in ("n1", "n2")] == [None, 0.3]
        assert metric("unknown", "n1") == 1
    metrics.show([node_report("n1", age=0.4)])
    assert metric("silence_seconds", "n1") == 0.4


def test_metrics_of_a_node_that_is_gone_are_removed(metrics):
    metrics.show([node_report("n1"), node_report("n2")])
    metrics.show([node_report("n2")])
    assert [metric(name, "n1") for name in ("unknown", "silence_seconds", "flapping")] == [None, None, None]
    assert metric("unknown", "n2") == 0
