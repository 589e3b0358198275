"""Any sensor that speaks MQTT as evidence for an area: profiles, numbers, availability, silence, changed formats."""

import json

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.messages import (
    AreaDefinition,
    AreaHazard,
    Availability,
    FusionPolicy,
    Limits,
    NodeReading,
    Source,
    UnknownPolicy,
)
from fog_contracts.site import NodeSite, Sonar
from hazard_aggregator.area_size import AreaError
from hazard_aggregator.areas import fuse
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.node_state import FlapDetector
from hazard_aggregator.registry import find_rule
from hazard_aggregator.source_values import PROFILES

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
TOO_LONG = object()
ABOVE_40 = Limits(above=40.0, hysteresis=2.0, minimum=-40.0, maximum=120.0)


def text(value: object) -> bytes:
    if isinstance(value, bytes):
        return value
    return value.encode() if isinstance(value, str) else json.dumps(value).encode()


class Rig:
    """An area with sources, whose messages arrive at a clock that the test moves."""

    def __init__(self, *sources: Source, **fields) -> None:
        definition = AreaDefinition(id="hall", polygon=SQUARE, sources=list(sources), **fields)
        self.fusion = AreaFusion([definition], [], 1, registry=find_rule)
        self.hazards: list[AreaHazard] = []
        self.now = 100.0
        self.wait(0.0)

    def send(self, topic: str, value: object, *, retained: bool = False) -> str:
        payload = None if value is TOO_LONG else text(value)
        self.hazards += self.fusion.on_source(topic, payload, self.now, self.now, retained=retained)
        return self.hazard.state

    def wait(self, seconds: float) -> str:
        end = self.now + seconds
        while self.now < end:
            self.now = min(self.now + 0.25, end)
            self.fusion.tick(self.now, self.now)
        self.fusion.tick(self.now, self.now)
        return self.hazard.state

    @property
    def states(self) -> dict[str, str]:
        return {report.id: report.state for report in self.fusion.node_reports(self.now)}

    @property
    def hazard(self) -> AreaHazard:
        return self.fusion.hazards()[0]


# Device, topic and payloads that mean blocked and clear, as the projects' sources write them: Zigbee2MQTT 2.12
# (lib/controller.ts), ESPHome 2024.11 (mqtt_binary_sensor.cpp, mqtt_sensor.cpp), Tasmota 14 (xsns_22_sr04.ino), Home
# Assistant 2026 (mqtt_statestream); of Shelly's devices, as the documentation does.
DOCUMENTED = {
    "zigbee2mqtt-occupancy": (
        "hall_motion",
        "zigbee2mqtt/hall_motion",
        {"battery": 88, "illuminance": 12, "linkquality": 102, "occupancy": True, "voltage": 2995},
        {"battery": 88, "illuminance": 14, "linkquality": 96, "occupancy": False, "voltage": 2995},
    ),
    "zigbee2mqtt-contact": (
        "fire door",
        "zigbee2mqtt/fire door",
        {"battery": 100, "contact": True, "linkquality": 80, "tamper": False},
        {"battery": 100, "contact": False, "linkquality": 78, "tamper": False},
    ),
    "esphome-distance": (
        "garage-node/sensor/parking_distance",
        "garage-node/sensor/parking_distance/state",
        "0.62",
        "2.31",
    ),
    "esphome-binary": ("gate/binary_sensor/beam", "gate/binary_sensor/beam/state", "ON", "OFF"),
    "tasmota-distance": (
        "corridor",
        "tele/corridor/SENSOR",
        {"Time": "2026-11-21T10:00:00", "SR04-1": {"Distance": 62.4}},
        {"Time": "2026-11-21T10:00:10", "SR04-1": {"Distance": 231.0}},
    ),
    "shelly-door-gen1": ("shellydw2-A1B2C3", "shellies/shellydw2-A1B2C3/sensor/state", "close", "open"),
    "shelly-door-gen2": (
        "shellyplusi4-a0a3b3c4d5e6",
        "shellyplusi4-a0a3b3c4d5e6/status/input:0",
        {"id": 0, "state": True},
        {"id": 0, "state": False},
    ),
    "home-assistant": (
        "homeassistant/binary_sensor/lift_door", "homeassistant/binary_sensor/lift_door/state", "on", "off",
    ),
}  # fmt: skip
# What says that a sensor is connected, and that it is not.
STATE = ({"state": "online"}, {"state": "offline"})
AVAILABILITY = {
    "zigbee2mqtt-occupancy": {"zigbee2mqtt/bridge/state": STATE, "zigbee2mqtt/hall_motion/availability": STATE},
    "zigbee2mqtt-contact": {"zigbee2mqtt/bridge/state": STATE, "zigbee2mqtt/fire door/availability": STATE},
    "esphome-distance": {},
    "esphome-binary": {"gate/status": ("online", "offline")},
    "tasmota-distance": {"tele/corridor/LWT": ("Online", "Offline")},
    "shelly-door-gen1": {},
    "shelly-door-gen2": {"shellyplusi4-a0a3b3c4d5e6/online": ("true", "false")},
    "home-assistant": {"homeassistant/status": ("online", "offline")},
}
LIMITS = {"esphome-distance": Limits(below=1.2, hysteresis=0.1), "tasmota-distance": Limits(below=120.0)}
EACH_AVAILABILITY = [(profile, topic) for profile, topics in AVAILABILITY.items() for topic in topics]


def of_profile(profile: str) -> tuple[Rig, str, object, object]:
    """Return a rig with a source of a profile, its topic, and what means blocked and clear."""
    device, topic, blocked, clear = DOCUMENTED[profile]
    rig = Rig(Source(id="s1", profile=profile, device=device, number=LIMITS.get(profile)))
    return rig, topic, blocked, clear


def connected(profile: str) -> tuple[Rig, str, object, object]:
    """Return the same with a sensor that is connected, as the broker retains it."""
    found = of_profile(profile)
    for availability, (online, _) in AVAILABILITY[profile].items():
        found[0].send(availability, online, retained=True)
    return found


def test_every_profile_is_tested_on_documented_payloads():
    assert DOCUMENTED.keys() == AVAILABILITY.keys() == PROFILES.keys()


@pytest.mark.parametrize("profile", DOCUMENTED)
def test_profile_understands_the_documented_payloads(profile):
    rig, topic, blocked, clear = connected(profile)
    assert rig.fusion.source_topics() == {topic, *AVAILABILITY[profile]}
    assert rig.hazard.state == "unknown"
    assert rig.send(topic, blocked) == "blocked"
    assert rig.send(topic, clear) == "clear"
    assert rig.hazard.nodes == {"s1": "clear"}


def is_periodic(profile: str) -> bool:
    return PROFILES[profile].period_s is not None


@pytest.mark.parametrize(("profile", "silent"), EACH_AVAILABILITY)
def test_nothing_is_clear_while_anything_that_should_has_not_said_that_the_sensor_is_connected(profile, silent):
    rig, topic, blocked, clear = of_profile(profile)
    for availability, (online, _) in AVAILABILITY[profile].items():
        if availability != silent:
            rig.send(availability, online, retained=True)
    assert rig.send(topic, clear) == "unknown"
    assert f"source s1: it reports clear, but {silent} must say first that it is connected" in rig.hazard.cause
    assert rig.send(topic, blocked) == "blocked"
    assert rig.send(topic, clear) == "unknown"
    assert rig.hazard.penalty == 254
    connected_now = rig.send(silent, AVAILABILITY[profile][silent][0], retained=True)
    assert connected_now == ("unknown" if is_periodic(profile) else "clear")
    assert rig.send(topic, clear) == "clear"


@pytest.mark.parametrize("after", ["gone", b"", "sleeping", {"status": "online"}, TOO_LONG])
@pytest.mark.parametrize(("profile", "availability"), EACH_AVAILABILITY)
def test_disconnected_sensor_is_unknown_until_it_is_connected_and_has_said_something(profile, availability, after):
    rig, topic, _, clear = connected(profile)
    assert rig.send(topic, clear) == "clear"
    online, offline = AVAILABILITY[profile][availability]
    assert rig.send(availability, offline if after == "gone" else after) == "unknown"
    reason = "offline" if after == "gone" else f"{availability} says neither online nor offline"
    assert reason in rig.hazard.cause
    assert rig.send(topic, clear, retained=True) == "unknown"
    assert rig.send(availability, online, retained=True) == "unknown"
    assert rig.send(topic, clear) == "clear"


@pytest.mark.parametrize("profile", ["esphome-binary", "home-assistant", "shelly-door-gen2"])
def test_value_that_comes_shortly_before_the_message_that_its_sensor_is_connected_waits_for_it(profile):
    """Home Assistant publishes states while it starts, and that it runs once it has started."""
    rig, topic, _, clear = of_profile(profile)
    ((availability, (online, offline)),) = AVAILABILITY[profile].items()
    rig.send(availability, offline)
    assert rig.send(topic, clear) == "unknown"
    assert rig.send(availability, online) == "clear"


@pytest.mark.parametrize("told", ["before", "while"])
def test_value_from_before_an_outage_clears_nothing_afterwards(told):
    rig = Rig(Source(id="s1", profile="esphome-binary", device="gate/binary_sensor/beam"))
    if told == "before":
        rig.send("gate/binary_sensor/beam/state", "OFF", retained=True)
    rig.send("gate/status", "offline", retained=True)
    if told == "while":
        rig.send("gate/binary_sensor/beam/state", "OFF", retained=True)
    assert rig.send("gate/status", "online") == "unknown"
    assert rig.send("gate/binary_sensor/beam/state", "OFF") == "clear"


OCCUPANCY = "zigbee2mqtt-occupancy"
HALL = "zigbee2mqtt/hall_motion"


@pytest.mark.parametrize("asleep", [False, True], ids=["device seen lately", "device gone"])
def test_zigbee2mqtt_that_starts_again_clears_nothing_by_what_it_knew_before(asleep):
    """Controller.start of Zigbee2MQTT 2.12: bridge/state, then each availability, then each state from its cache."""
    rig, topic, blocked, clear = connected(OCCUPANCY)
    assert rig.send(topic, clear) == "clear"
    assert rig.send("zigbee2mqtt/bridge/state", {"state": "offline"}) == "unknown"
    rig.send("zigbee2mqtt/bridge/state", {"state": "online"})
    rig.send(f"{HALL}/availability", {"state": "offline" if asleep else "online"})
    assert rig.send(topic, clear) == "unknown"
    if asleep:
        assert f"{HALL}/availability must say first" in rig.hazard.cause
        assert rig.send(f"{HALL}/availability", {"state": "online"}) == "unknown"
    else:
        assert "may repeat what it knew before" in rig.hazard.cause
    assert rig.send(topic, clear) == "clear"
    assert rig.send(topic, blocked) == "blocked"


def test_zigbee2mqtt_clears_nothing_by_what_it_knew_before_though_the_device_comes_after_the_gateway():
    rig, topic, _, clear = connected(OCCUPANCY)
    rig.send(f"{HALL}/availability", {"state": "offline"})
    rig.send("zigbee2mqtt/bridge/state", {"state": "offline"})
    rig.send("zigbee2mqtt/bridge/state", {"state": "online"})
    rig.send(f"{HALL}/availability", {"state": "online"})
    assert rig.send(topic, clear) == "unknown"
    assert "may repeat what it knew before" in rig.hazard.cause
    assert rig.send(topic, clear) == "clear"


def test_zigbee2mqtt_clears_nothing_by_what_it_knew_before_when_it_tells_home_assistant_that_has_started():
    """HomeAssistant.onMQTTMessage of Zigbee2MQTT 2.12: later bridge/state, then each state from its cache."""
    rig, topic, _, clear = connected(OCCUPANCY)
    rig.send("zigbee2mqtt/bridge/state", {"state": "offline"})
    rig.send("zigbee2mqtt/bridge/state", {"state": "online"})
    rig.send(f"{HALL}/availability", {"state": "online"})
    rig.send(topic, clear)
    rig.send("zigbee2mqtt/bridge/state", {"state": "online"})
    assert rig.send(topic, clear) == "unknown"
    assert rig.send(topic, clear) == "clear"
    rig.send("zigbee2mqtt/bridge/state", {"state": "online"})
    assert rig.send(topic, clear) == "clear"


def test_zigbee2mqtt_that_starts_again_blocks_by_what_it_knew_before():
    rig, topic, blocked, clear = connected(OCCUPANCY)
    rig.send("zigbee2mqtt/bridge/state", {"state": "offline"})
    rig.send("zigbee2mqtt/bridge/state", {"state": "online"})
    assert rig.send(topic, blocked) == "blocked"
    assert rig.send(topic, clear) == "clear"


def test_renamed_zigbee_device_is_unknown():
    """Bridge.renameEntity and Availability of Zigbee2MQTT 2.12 empty what is retained under the old name."""
    rig, topic, _, clear = connected(OCCUPANCY)
    assert rig.send(topic, clear) == "clear"
    assert rig.send(topic, b"", retained=False) == "unknown"
    rig.send(f"{HALL}/availability", b"")
    assert rig.wait(60.0) == "unknown"


def test_availability_is_understood_as_text_where_json_is_expected():
    """Zigbee2MQTT 1 could be set to send text, and the state of its bridge was one."""
    rig = of_profile(OCCUPANCY)[0]
    rig.send("zigbee2mqtt/bridge/state", "online", retained=True)
    rig.send(f"{HALL}/availability", "online", retained=True)
    assert rig.send(HALL, {"occupancy": False}) == "clear"
    assert rig.send(f"{HALL}/availability", "offline") == "unknown"


def test_message_of_a_sensor_does_not_say_that_it_is_connected():
    rig, topic, _, clear = of_profile(OCCUPANCY)
    rig.send(topic, clear)
    (report,) = rig.fusion.node_reports(rig.now)
    assert report.online is None
    rig.send(f"{HALL}/availability", {"state": "offline"})
    rig.send(topic, clear)
    (report,) = rig.fusion.node_reports(rig.now)
    assert report.online is False


# --- Distance sensors without an echo: Sr04Show of Tasmota leaves out the key, and sensors of ESPHome publish `nan`, or
# `None` with `publish_nan_as_none`.
NO_ECHO = {
    "tasmota-distance": [{"Time": "2026-11-21T10:00:10"}],
    "esphome-distance": ["nan", "None"],
}


@pytest.mark.parametrize("key", ["SR04", "SR04-1", "SR04_1"])
def test_distance_is_found_under_each_name_that_tasmota_gives_to_its_sensor(key):
    rig, topic, _, _ = connected("tasmota-distance")
    assert rig.send(topic, {"Time": "2026-11-21T10:00:00", key: {"Distance": 62.4}}) == "blocked"
    assert rig.send(topic, {"Time": "2026-11-21T10:00:10", key: {"Distance": 231.0}}) == "clear"


@pytest.mark.parametrize(("profile", "nothing"), [(name, each) for name, them in NO_ECHO.items() for each in them])
@pytest.mark.parametrize("meaning", ["unknown", "clear", "blocked"])
def test_message_without_an_echo_means_what_the_source_says(profile, nothing, meaning):
    device, topic, blocked, _ = DOCUMENTED[profile]
    rig = Rig(Source(id="s1", profile=profile, device=device, number=LIMITS[profile], no_value=meaning))
    for availability, (online, _) in AVAILABILITY[profile].items():
        rig.send(availability, online, retained=True)
    assert rig.send(topic, nothing) == ("blocked" if meaning == "blocked" else "unknown")
    assert rig.send(topic, blocked) == "blocked"
    assert rig.send(topic, nothing) == meaning
    assert "it measures nothing: " in rig.hazard.cause or meaning == "clear"
    rig.wait(200.0)
    assert rig.hazard.state == "unknown"
    assert rig.send(topic, nothing) == ("blocked" if meaning == "blocked" else "unknown"), "it may be gone since then"


def test_text_that_is_no_number_is_no_missing_echo():
    rig = Rig(Source(id="s1", topic="t", number=ABOVE_40, period_s=10.0, no_value="clear"))
    assert rig.send("t", "20") == "clear"
    assert rig.send("t", "n/a") == "unknown"
    assert rig.send("t", "") == "unknown"


@pytest.mark.parametrize("state", ["unavailable", "unknown", ""])
def test_state_that_means_nothing_is_unknown_with_what_it_said(state):
    rig, topic, _, clear = connected("home-assistant")
    assert rig.send(topic, clear) == "clear"
    assert rig.send(topic, state) == "unknown"
    assert f"{state!r} means neither blocked nor clear" in rig.hazard.cause


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        ({"presence": True}, "there is no /occupancy in it"),
        ("occupied", "is not JSON text"),
        ("[1, 2", "is not JSON text"),
        ([True], "there is no /occupancy in it"),
        ({"occupancy": 1}, "means neither blocked nor clear"),
        ({"occupancy": None}, "means neither blocked nor clear"),
    ],
)
def test_changed_format_is_unknown_with_the_reason_and_back_with_the_old_format(payload, reason):
    rig, topic, _, clear = connected(OCCUPANCY)
    assert rig.send(topic, clear) == "clear"
    assert rig.send(topic, payload) == "unknown"
    assert reason in rig.hazard.cause
    assert rig.fusion.pop_rejections() == [("s1", "implausible")]
    assert rig.send(topic, clear) == "clear"


@pytest.mark.parametrize("retained", [False, True])
def test_message_that_is_too_long_makes_its_source_unknown_at_once(retained):
    rig = Rig(Source(id="s1", profile="shelly-door-gen2", device="d"))
    rig.send("d/online", "true")
    assert rig.send("d/status/input:0", {"state": False}) == "clear"
    assert rig.send("d/status/input:0", TOO_LONG, retained=retained) == "unknown"
    assert "its message is too long" in rig.hazard.cause
    assert rig.send("d/status/input:0", {"state": False}) == "clear"


@pytest.mark.parametrize("noise", [[900.0 + i for i in range(50)], [f"E{i}" for i in range(50)], [{"x": 1}, TOO_LONG]])
def test_wrong_values_that_change_are_one_hazard_with_the_first_reason(noise):
    rig = Rig(Source(id="s1", topic="t", pointer="/t", number=ABOVE_40, period_s=10.0))
    rig.send("t", {"t": 20})
    rig.hazards.clear()
    for value in noise:
        assert rig.send("t", value if value is TOO_LONG else {"t": value}) == "unknown"
    assert len(rig.hazards) == 1
    assert rig.send("t", {"t": 20}) == "clear"
    assert rig.send("t", {"t": 121}) == "unknown"
    assert "121 is implausible: it should be at least -40, at most 120" in rig.hazard.cause


def test_changed_source_asks_for_what_the_broker_retains_and_an_unchanged_one_does_not():
    door = Source(id="door", profile="shelly-door-gen2", device="d")
    rig = Rig(door, Source(id="other", topic="o", blocked=["1"], clear=["0"], period_s=10.0))
    assert rig.fusion.pop_new_source_topics() == {"d/online", "d/status/input:0", "o"}
    turned = msgspec.structs.replace(door, blocked=[False], clear=[True])
    sources = [turned, *rig.fusion.definitions()[0].sources[1:]]
    rig.fusion.put_area(AreaDefinition(id="hall", polygon=SQUARE, sources=sources), rig.now)
    assert rig.fusion.pop_new_source_topics() == {"d/online", "d/status/input:0"}
    assert rig.fusion.pop_new_source_topics() == set()


def test_reading_under_the_id_of_a_source_does_not_count_for_it():
    rig = Rig(Source(id="s1", topic="t", blocked=["1"], clear=["0"], period_s=60.0))
    rig.send("t", "1")
    for seq in range(20):
        reading = NodeReading(seq=seq, boot=1, uptime_ms=100 * seq, range_m=[3.0], status=["ok"], state="clear")
        rig.now += 0.1
        rig.fusion.on_reading("s1", reading, rig.now, rig.now)
    assert rig.hazard.state == "blocked"


def test_source_with_a_period_is_unknown_after_three_of_them():
    rig = Rig(Source(id="s1", topic="t", blocked=["1"], clear=["0"], period_s=2.0))
    rig.send("t", "0")
    assert rig.wait(5.5) == "clear"
    assert rig.wait(1.0) == "unknown"
    assert "silent for more than 6 s" in rig.hazard.cause
    assert rig.send("t", "0") == "clear"


def test_source_that_publishes_on_change_keeps_its_state_while_its_sensor_is_connected():
    rig = Rig(Source(id="s1", profile="shelly-door-gen2", device="d"))
    rig.send("d/online", "true")
    rig.send("d/status/input:0", {"id": 0, "state": False})
    assert rig.wait(120.0) == "clear"


def test_source_that_publishes_on_change_is_unknown_once_the_broker_was_lost_until_it_says_something():
    door = Rig(Source(id="s1", profile="shelly-door-gen2", device="d"))
    door.send("d/online", "true")
    assert door.send("d/status/input:0", {"state": False}) == "clear"
    changed = door.fusion.on_connection_lost(door.now)
    assert [(hazard.area, hazard.state) for hazard in changed] == [("hall", "unknown")]
    # Retained, at the next connection: the door may have opened and its message be lost.
    assert door.send("d/online", "true", retained=True) == "unknown"
    assert door.wait(600.0) == "unknown"
    assert door.send("d/status/input:0", {"state": True}) == "blocked"


def test_source_with_a_period_needs_no_connection_to_be_judged():
    periodic = Rig(Source(id="s1", topic="t", blocked=["1"], clear=["0"], period_s=2.0))
    assert periodic.send("t", "0") == "clear"
    assert periodic.fusion.on_connection_lost(periodic.now) == []
    assert periodic.wait(1.0) == "clear"
    assert periodic.wait(10.0) == "unknown"


def test_retained_message_counts_only_for_a_connected_sensor_that_publishes_on_change():
    periodic = Rig(Source(id="s1", topic="t", blocked=["1"], clear=["0"], period_s=2.0))
    assert periodic.send("t", "0", retained=True) == "unknown"
    door = Rig(Source(id="s1", profile="shelly-door-gen2", device="d"))
    assert door.send("d/status/input:0", {"state": False}, retained=True) == "unknown"
    assert door.send("d/online", "false", retained=True) == "unknown"
    assert door.send("d/online", "true") == "unknown"
    assert door.send("d/status/input:0", {"state": False}, retained=True) == "clear"
    late = Rig(Source(id="s1", profile="shelly-door-gen2", device="d"))
    late.send("d/status/input:0", {"state": False}, retained=True)
    assert late.send("d/online", "true", retained=True) == "clear"


def test_number_has_limits_with_hysteresis_and_a_plausible_range():
    rig = Rig(Source(id="s1", topic="t", pointer="/t", number=ABOVE_40, period_s=10.0))
    assert rig.send("t", {"t": 39.5}) == "blocked"  # within the hysteresis, and no side known: counts as a danger
    assert rig.send("t", {"t": 37.9}) == "clear"
    assert rig.send("t", {"t": 39.9}) == "clear"
    assert rig.send("t", {"t": 40.1}) == "blocked"
    assert "40.1 is above 40" in rig.hazard.cause
    assert rig.send("t", {"t": 38.1}) == "blocked"
    assert rig.send("t", {"t": 121}) == "unknown"
    assert rig.hazard.penalty == 254  # it was blocked before
    assert rig.send("t", {"t": 37.0}) == "clear"


@pytest.mark.parametrize("value", [True, "hot", None, [], "nan", "inf", 10**400, "1_9", "\u0661\u0669"])
def test_value_that_is_no_number_is_a_changed_format(value):
    rig = Rig(Source(id="s1", topic="t", pointer="/t", number=ABOVE_40, period_s=10.0))
    payload = value if isinstance(value, int) and value > 1 else json.dumps({"t": value})
    rig.send("t", {"t": 20})
    assert rig.send("t", payload if isinstance(payload, str) else f'{{"t": {payload}}}') == "unknown"


@given(st.lists(st.floats(-40.0, 120.0), min_size=1, max_size=40))
def test_number_is_blocked_above_its_limit_and_clear_only_below_its_hysteresis(values):
    rig = Rig(Source(id="s1", topic="t", number=ABOVE_40, period_s=10.0))
    before = "unknown"
    for value in values:
        state = rig.send("t", repr(value))
        assert state == ("blocked" if value > 40.0 else "clear" if value <= 38.0 else state)
        if 38.0 < value <= 40.0:
            assert state == (before if before != "unknown" else "blocked")
        before = state


def test_source_with_a_penalty_makes_a_clear_area_costly_and_never_impassable():
    hot = Source(id="hot", topic="t", number=ABOVE_40, period_s=10.0, penalty=120)
    door = Source(id="door", topic="d", blocked=["1"], clear=["0"], period_s=10.0)
    rig = Rig(hot, door)
    rig.send("d", "0")
    assert rig.send("t", "20") == "clear"
    assert rig.send("t", "50") == "unknown"
    assert (rig.hazard.penalty, rig.hazard.severity) == (120, 1)
    assert "source hot: 50 is above 40" in rig.hazard.cause
    assert rig.send("d", "1") == "blocked"
    assert rig.send("d", "0") == "unknown"
    assert rig.hazard.penalty == 120
    assert rig.send("t", "20") == "clear"
    alone = Rig(hot)
    assert alone.send("t", "50") == "unknown"
    assert alone.hazard.penalty == 120
    assert alone.send("t", "20") == "clear"


def test_one_message_for_two_sources():
    front = Source(id="front", topic="lobby", pointer="/front", blocked=["1"], clear=["0"], period_s=10.0)
    back = Source(id="back", topic="lobby", pointer="/back", blocked=["1"], clear=["0"], period_s=10.0)
    rig = Rig(front, back)
    assert rig.fusion.source_topics() == {"lobby"}
    assert rig.send("lobby", {"front": "1", "back": "0"}) == "blocked"
    assert rig.states == {"front": "blocked", "back": "clear"}


@pytest.mark.parametrize("field", ["topic", "availability"])
@pytest.mark.parametrize(
    ("topic", "problem"),
    [
        ("a\u0000b", "U\\+0000, which brokers refuse"),
        ("a\u0001b", "U\\+0001, which brokers refuse"),
        ("a\u007f", "U\\+007F, which brokers refuse"),
        ("a\u0085", "U\\+0085, which brokers refuse"),
        ("\ufffe", "U\\+FFFE, which brokers refuse"),
        ("\U0001ffff", "U\\+1FFFF, which brokers refuse"),
        ("\ufdd0", "U\\+FDD0, which brokers refuse"),
        ("$share/group/door", "the broker's own, or a shared subscription"),
        ("$SYS/broker/uptime", "the broker's own, or a shared subscription"),
        ("doors/+/state", "has a wildcard .* give each sensor a source of its own"),
        ("doors/#", "has a wildcard .* give each sensor a source of its own"),
        ("a/b+/c", "has a wildcard"),
        ("{device}", "it is empty"),
        ("door" + "/" * 201, "it has 201 slashes, and brokers refuse more than 200"),
    ],
)
def test_topic_that_no_single_sensor_has_is_refused(field, topic, problem):
    topics = {"topic": "door", "availability": Availability(topic="status")}
    topics[field] = topic if field == "topic" else Availability(topic=topic)
    with pytest.raises(AreaError, match=f"area hall: sources\\.s1\\.{field}.*{problem}"):
        Rig(Source(id="s1", blocked=["1"], clear=["0"], **topics))


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("device", ["a\u0001", "+", "a/#"])
def test_device_that_spoils_its_topic_is_refused(profile, device):
    with pytest.raises(AreaError, match=r"area hall: sources\.s1\."):
        Rig(Source(id="s1", profile=profile, device=device, number=LIMITS.get(profile)))


@pytest.mark.parametrize("device", ["gate/binary_sensor/beam", "building/gate/binary_sensor/beam"])
def test_device_of_esphome_goes_offline_on_all_of_its_prefix(device):
    prefix = device.removesuffix("/binary_sensor/beam")
    rig = Rig(Source(id="s1", profile="esphome-binary", device=device))
    rig.send(f"{prefix}/status", "online")
    assert rig.send(f"{device}/state", "OFF") == "clear"
    assert rig.send(f"{prefix}/status", "offline") == "unknown"


@pytest.mark.parametrize("device", ["gate", "binary_sensor/beam", "gate/beam", "gate/binary_sensor/"])
def test_device_of_esphome_without_its_prefix_is_refused(device):
    with pytest.raises(AreaError, match=r"sources\.s1\.device: .* is no PREFIX/binary_sensor/NAME"):
        Rig(Source(id="s1", profile="esphome-binary", device=device))


def test_changed_area_keeps_the_states_of_sources_that_did_not_change():
    door = Source(id="door", topic="d", blocked=["1"], clear=["0"], period_s=10.0)
    rig = Rig(door)
    rig.send("d", "0")
    other = Source(id="other", topic="o", blocked=["1"], clear=["0"], period_s=10.0)
    changed = AreaDefinition(id="hall", polygon=SQUARE, sources=[door, other])
    rig.fusion.put_area(changed, rig.now)
    assert rig.states == {"door": "clear", "other": "unknown"}
    assert rig.send("o", "0") == "clear"
    rig.fusion.put_area(AreaDefinition(id="hall", polygon=SQUARE), rig.now)
    assert rig.fusion.source_topics() == set()
    assert rig.wait(70.0) == "unknown"


BAD = Source(id="s1", topic="t", blocked=["1"], clear=["0"], period_s=1.0)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (Source(id="s1"), r"area hall: sources\.s1\.topic: it has none"),
        (Source(id="s1", profile="knx"), r"sources\.s1\.profile: there is no knx \(known: zigbee2mqtt-occupancy"),
        (Source(id="s1", profile="home-assistant"), r"sources\.s1\.device: the profile home-assistant needs one"),
        (Source(id="s1", topic="t", period_s=1.0), "neither which values mean blocked and clear"),
        (Source(id="s1", topic="t", period_s=1.0, number=Limits()), "it needs `above` or `below`"),
        (
            Source(id="s1", topic="t", period_s=1.0, number=Limits(above=1.0, below=2.0)),
            r"sources\.s1\.number: nothing would be clear: .* at least 2 and at most 1\. Raise `above`",
        ),
        (
            Source(id="s1", topic="t", period_s=1.0, number=Limits(above=45.0, below=40.0, hysteresis=3.0)),
            "nothing would",
        ),
        (Source(id="s1", topic="t", period_s=1.0, number=Limits(above=45.0, minimum=60.0)), "nothing would be clear"),
        (
            Source(id="s1", topic="t", blocked=["On", 1.0], clear=["off", "ON"], period_s=1.0),
            r"sources\.s1: 'On' means both blocked and clear: take it out of one of them",
        ),
        (
            Source(
                id="s1", topic="t", blocked=["1"], clear=["0"], availability=Availability(topic="s", online=["offline"])
            ),
            r"sources\.s1\.availability: 'offline' means both online and offline",
        ),
        (Source(id="s1", topic="t", blocked=["1"], clear=["0"]), "nobody would notice that it is dead"),
        (Source(id="s1", topic="t", blocked=["1"], clear=["0"], period_s=1.0, debounce={"rule": "x"}), "debounce.rule"),
    ],
)
def test_invalid_source_is_refused_naming_area_source_field_and_remedy(source, message):
    with pytest.raises(AreaError, match=message):
        Rig(source)


def test_two_sources_with_one_id_and_a_quorum_out_of_reach_are_refused():
    with pytest.raises(AreaError, match=r"sources\.s1: another node or source"):
        Rig(BAD, BAD)
    with pytest.raises(AreaError, match=r"fusion\.at_least: 3 is more than all nodes and sources have together \(1\)"):
        Rig(BAD, fusion=FusionPolicy(rule="quorum", at_least=3))


def test_flapping_source_is_unknown_until_it_keeps_one_state():
    policy = UnknownPolicy(max_changes=4)
    rig = Rig(Source(id="s1", topic="t", blocked=["1"], clear=["0"], period_s=10.0), unknown=policy)
    for i in range(5):
        rig.send("t", str(i % 2))
        rig.wait(1.0)
    assert rig.send("t", "1") == "unknown"
    assert "it flaps: it changed more than 4 times within a minute" in rig.hazard.cause
    rig.send("t", "0")
    rig.wait(4.0)
    assert rig.send("t", "0") == "unknown"
    rig.wait(2.0)
    assert rig.send("t", "0") == "clear"


@pytest.mark.parametrize("value", [20, 60])
def test_source_that_is_understood_and_not_in_turn_flaps_and_makes_no_hazard_with_each_message(value):
    rig = Rig(Source(id="s1", topic="t", number=ABOVE_40, period_s=10.0), unknown=UnknownPolicy(max_changes=6))
    for step in range(600):
        rig.send("t", value if step % 2 == 0 else 500 + step)
        rig.wait(0.1)
    assert len(rig.hazards) <= 6 + 2
    assert "it flaps" in rig.hazard.cause
    for _ in range(60):
        rig.send("t", 500)
        rig.wait(0.1)
    assert "500 is implausible" in rig.hazard.cause
    for _ in range(60):
        rig.send("t", value)
        rig.wait(0.1)
    assert rig.hazard.state == ("clear" if value == 20 else "blocked")
    assert len(rig.hazards) <= 6 + 2 + 2


@given(st.lists(st.tuples(st.floats(0.0, 30.0), st.sampled_from(["blocked", "clear"])), max_size=60))
def test_few_changes_within_a_minute_are_no_flapping(steps):
    detector, now, changes, last = FlapDetector(5), 0.0, [], None
    for pause, state in steps:
        now += pause
        if last is not None and state != last:
            changes.append(now)
        last = state
        if detector.update(state, now):
            assert len([at for at in changes if now - at <= 66.0]) > 5


STATES = st.dictionaries(st.sampled_from(list("abcdef")), st.sampled_from(["blocked", "clear", "unknown"]))
POLICIES = st.builds(
    FusionPolicy,
    rule=st.sampled_from(["any", "all", "quorum", "weighted"]),
    at_least=st.integers(1, 6).map(float),
    weights=st.dictionaries(st.sampled_from(list("abcdef")), st.integers(0, 3).map(float)),
)


@given(STATES, POLICIES)
def test_unknown_means_that_the_unknown_ones_decide(states, policy):
    """Whatever the unknown ones would say: blocked and clear areas stay so, and unknown ones could become either."""
    outcomes = {
        fuse({name: guess if state == "unknown" else state for name, state in states.items()}, policy)
        for guess in ("blocked", "clear")
    }
    fused = fuse(states, policy)
    if not states:
        assert fused == "unknown"
    elif fused == "unknown":
        assert outcomes == {"blocked", "clear"}
    else:
        assert outcomes == {fused}


@pytest.mark.parametrize(
    ("rule", "at_least", "states", "expected"),
    [
        ("any", 1, "bcc", "blocked"), ("any", 1, "cuc", "unknown"), ("any", 1, "ccc", "clear"),
        ("all", 1, "bbc", "clear"), ("all", 1, "bbb", "blocked"), ("all", 1, "bbu", "unknown"),
        ("quorum", 2, "bbc", "blocked"), ("quorum", 2, "buc", "unknown"), ("quorum", 2, "ucc", "clear"),
    ],
)  # fmt: skip
def test_fusion_rules(rule, at_least, states, expected):
    named = {"b": "blocked", "c": "clear", "u": "unknown"}
    members = {f"n{i}": named[letter] for i, letter in enumerate(states)}
    assert fuse(members, FusionPolicy(rule=rule, at_least=at_least)) == expected


def test_weights_count_as_evidence():
    policy = FusionPolicy(rule="weighted", at_least=2, weights={"camera": 2, "pir": 0.5})
    assert fuse({"camera": "blocked", "pir": "clear"}, policy) == "blocked"
    assert fuse({"camera": "clear", "pir": "blocked"}, policy) == "clear"
    assert fuse({"camera": "unknown", "pir": "clear"}, policy) == "unknown"


def test_source_never_has_the_id_of_a_node_whose_readings_would_count_for_it():
    node = NodeSite(id="n1", area="yard", x=0.0, y=0.0, theta=0.0, sonars=[Sonar(range_limit=1.0)])
    source = Source(id="n1", topic="door", blocked=["shut"], clear=["open"], period_s=5.0)
    with pytest.raises(AreaError, match=r"sources\.n1.*a node of the site has this id"):
        AreaFusion([AreaDefinition(id="hall", polygon=SQUARE, sources=[source])], [node], 1, registry=find_rule)


def test_policy_that_the_only_thesis_node_could_never_reach_is_refused():
    quorum = AreaDefinition(id="hall", polygon=SQUARE, number=5, fusion=FusionPolicy(rule="quorum", at_least=2.0))
    with pytest.raises(AreaError, match="more than all nodes and sources have"):
        AreaFusion([quorum], [], 1, registry=find_rule)


def test_pointer_to_a_digit_that_is_no_index_makes_its_source_unknown():
    rig = Rig(Source(id="s", topic="t", pointer="/\u00b2", blocked=["on"], clear=["off"], period_s=5.0))
    assert rig.send("t", ["on", "off", "on"]) == "unknown"
    assert "its format has changed" in rig.hazard.cause
