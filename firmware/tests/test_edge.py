"""What the board's part consists of: settings, staying connected, and Home Assistant's description of the node."""

import ctypes
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts import channels as ch

PINS = ({"trigger": 14, "echo": 5, "range_limit_m": 1.5}, {"trigger": 12, "echo": 4, "range_limit_m": 2.0})
SETTINGS = {
    "site": "lab",
    "node": "n1",
    "wifi_name": "caf\u00e9 \u20ac",
    "wifi_password": 'p"\\ss',
    "broker": "fog.lan",
    "sonars": list(PINS),
}


def problem(core, settings, *, esp32=False, **options):
    text = json.dumps(settings, **options) if isinstance(settings, dict) else settings
    function = core["fognav_settings_problem"]
    function.restype = ctypes.c_char_p
    found = function(text.encode(), ctypes.c_uint32(len(text.encode())), int(esp32))
    return found and found.decode()


@pytest.mark.parametrize("ascii_only", [True, False])
def test_settings_with_any_text_are_valid(core, ascii_only):
    assert problem(core, SETTINGS, ensure_ascii=ascii_only) is None
    options = {"port": 1883, "tls": False, "user": "u", "password": "p", "thesis_area": 4, "home_assistant": True}
    assert problem(core, {**SETTINGS, **options, "every_reading": True}) is None


KEY = "04" + "ab" * 64


def pins(core, settings, index, *, esp32=False):
    text = json.dumps(settings).encode()
    trigger, echo = ctypes.c_int(), ctypes.c_int()
    core["fognav_settings_pins"](
        text, ctypes.c_uint32(len(text)), int(esp32), index, ctypes.byref(trigger), ctypes.byref(echo)
    )
    return trigger.value, echo.value


@pytest.mark.parametrize(
    ("profile", "esp32", "expected"),
    [
        ("standard", False, [(14, 5), (12, 4)]),
        ("thesis", False, [(16, 5), (0, 12)]),
        ("standard", True, [(18, 22), (19, 21)]),
        ("thesis", True, [(26, 22), (17, 19)]),
    ],
)
def test_sonars_without_pins_get_those_of_the_profile(core, profile, esp32, expected):
    settings = {**SETTINGS, "profile": profile, "sonars": [{"range_limit_m": 1}, {"range_limit_m": 2}]}
    assert problem(core, settings, esp32=esp32) is None
    assert [pins(core, settings, index, esp32=esp32) for index in range(2)] == expected


@pytest.mark.parametrize(
    ("sonar", "esp32", "words"),
    [
        ({"trigger": 14, "echo": 16}, False, "can't tell of edges"),
        ({"trigger": 6, "echo": 5}, False, "can't be driven"),
        ({"trigger": 34, "echo": 22}, True, "can't be driven"),
        ({"trigger": 17, "echo": 34}, True, None),
        ({"trigger": 17, "echo": 5}, False, "can't be driven"),
    ],
)
def test_pins_that_a_board_does_not_have_are_refused(core, sonar, esp32, words):
    found = problem(core, {**SETTINGS, "sonars": [{**sonar, "range_limit_m": 1}]}, esp32=esp32)
    assert found is None if words is None else words in found


def ranger(**more):
    return {"sensor": "vl53l1x", "range_limit_m": 1, **more}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sonars": [ranger()]}, None),
        ({"sonars": [ranger(shutdown=14), ranger(shutdown=12), ranger()]}, None),
        ({"sonars": [ranger(), ranger()]}, "several rangers"),
        ({"sonars": [ranger(), PINS[0]]}, "I2C"),
        ({"sonars": [ranger(sensor="radar")]}, "none of hc-sr04"),
        ({"values": [{"kind": "temperature", "sensor": "ds18b20", "pin": 13}]}, None),
        ({"values": [{"kind": "gas", "sensor": "analog", "full_scale_v": 3.2}]}, None),
        ({"values": [{"kind": "temperature", "sensor": "ds18b20"}]}, "can't be driven"),
        ({"values": [{"kind": "temperature", "sensor": "ds18b20", "pin": 14}]}, "share a pin"),
        ({"values": [{"kind": "Gas", "sensor": "analog"}]}, "a value's kind"),
        ({"values": [{"kind": "gas", "sensor": "nose"}]}, "neither ds18b20"),
        ({"values": [{"kind": "gas", "sensor": "analog", "full_scale_v": 0}]}, "full_scale_v"),
        ({"values": [{"kind": "gas", "sensor": "analog", "x": 0}]}, "a value in node.json"),
        ({"values": [{"kind": "gas", "sensor": "analog"}] * 5}, "four values"),
        ({"button": 13}, None),
        ({"button": 5}, "share a pin"),
        ({"button": 40}, "0 to 39"),
        ({"temperature_c": -5.5}, None),
        ({"temperature_c": 80}, "temperature_c"),
        ({"profile": "best"}, "neither standard"),
        ({"update_key": KEY}, None),
        ({"update_key": KEY[:-2]}, "update_key"),
        ({"update_key": "05" + KEY[2:]}, "update_key"),
        ({"update_key": KEY[:-1] + "G"}, "update_key"),
    ],
)
def test_further_settings(core, change, words):
    found = problem(core, {**SETTINGS, **change})
    assert found is None if words is None else words in found, found


@pytest.mark.parametrize("name", ["site", "node", "wifi_name", "broker", "sonars"])
def test_missing_setting_is_named(core, name):
    assert name in problem(core, {key: value for key, value in SETTINGS.items() if key != name})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"node": "N 1"}, "node is missing, or not made of"),
        ({"node": "n" * 33}, "too long"),
        ({"wifi": "x"}, "no setting is called"),
        ({"port": 0}, "port"),
        ({"port": "8883"}, "wrong type"),
        ({"sonars": [{**PINS[0], "pin": 3}]}, "a sonar in node.json has a member"),
        ({"sonars": [{**PINS[0], "echo": 14}]}, "same pin"),
        ({"sonars": [PINS[0], {**PINS[1], "echo": 5}]}, "share a pin"),
        ({"sonars": [{**PINS[0], "range_limit_m": 0}]}, "range_limit_m"),
        ({"sonars": [{"trigger": 1, "echo": 2}]}, "range_limit_m"),
        ({"sonars": [{"echo": 2, "range_limit_m": 1}]}, "no trigger"),
        ({"sonars": [{"trigger": 2 * i, "echo": 2 * i + 1, "range_limit_m": 1} for i in range(9)]}, "eight"),
    ],
)
def test_invalid_setting_is_refused_in_words(core, change, words):
    assert words in problem(core, {**SETTINGS, **change})


def test_home_assistant_learns_the_nodes_topics_and_sonars(core):
    text = json.dumps(SETTINGS).encode()
    buffer = ctypes.create_string_buffer(ch.HOME_ASSISTANT.limit)
    length = core["fognav_discovery"](text, ctypes.c_uint32(len(text)), buffer, ctypes.c_uint32(len(buffer)))
    found = json.loads(buffer.raw[:length])
    assert found["dev"]["ids"] == "fognav-lab-n1"
    assert found["state_topic"] == "fog/v1/lab/nodes/n1/reading"
    assert found["availability_topic"] == "fog/v1/lab/nodes/n1/availability"
    assert set(found["cmps"]) == {"state", "range-0", "range-1"}
    assert len({component["unique_id"] for component in found["cmps"].values()}) == 3


class Connection:
    """The board's connection in front of a network and a broker that a test switches; the radio takes 2 s, TLS 1 s."""

    def __init__(self, core, seed=7, start_ms=0):
        self._new, self._free, self._step = (core[f"fognav_connection_{name}"] for name in ("new", "free", "step"))
        self._new.restype = ctypes.c_void_p
        self._test = ctypes.c_void_p(self._new(ctypes.c_uint32(seed)))
        self._now = start_ms
        self._counts = (ctypes.c_int * 5)()
        self._joined_at = self._connected_at = None
        self.network = self.broker = True
        self.refused = False
        self.joins, self.connects, self.announcements, self.restarts, self.leaves = [], [], [], [], []
        self.up = False

    def close(self):
        self._free(self._test)

    def run(self, seconds):
        for _ in range(round(seconds * 20)):
            self._now += 50
            self._advance()

    def _advance(self):
        network = self.network and self._joined_at is not None and self._now - self._joined_at >= 2000
        reached = network and self.broker and self._connected_at is not None and self._now - self._connected_at >= 1000
        broker = reached and not self.refused
        before = list(self._counts)
        arguments = (int(network), int(broker), int(bool(reached and self.refused)), self._counts)
        self.up = bool(self._step(self._test, ctypes.c_uint32(self._now % 2**32), *arguments))
        times = (self.joins, self.connects, self.announcements, self.restarts, self.leaves)
        for moments, old, new in zip(times, before, self._counts, strict=True):
            assert new - old in {0, 1}
            moments.extend([self._now] * (new - old))
        if self.joins and self.joins[-1] == self._now:
            self._joined_at = self._now
        if self.connects and self.connects[-1] == self._now:
            self._connected_at = self._now
        if self.leaves and self.leaves[-1] == self._now:
            self._connected_at = None
        if not self.network:
            self._joined_at = None
        if not (self.network and self.broker):
            self._connected_at = None


@pytest.fixture
def connection(core):
    made = Connection(core)
    yield made
    made.close()


def test_node_boots_faster_than_the_router_and_connects_when_it_is_there(connection):
    connection.network = False
    connection.run(300)
    assert not connection.up
    connection.network = True
    connection.run(60)
    assert connection.up


def test_refused_node_asks_ever_more_rarely(connection):
    connection.refused = True
    connection.run(540)
    gaps = [later - earlier for earlier, later in zip(connection.connects, connection.connects[1:], strict=False)]
    assert gaps[0] < 3000
    assert all(15_000 <= gap <= 32_000 for gap in gaps[8:])
    assert len(connection.connects) < 40
    # The MQTT library ignores an attempt that follows a disconnection at once.
    assert all(
        later - max(moment for moment in connection.leaves if moment <= later) >= 250
        for later in connection.connects[1:]
    )


def test_hundred_nodes_do_not_come_back_at_one_moment(core):
    moments = set()
    for seed in range(1, 101):
        node = Connection(core, seed)
        node.broker = False
        node.run(120)
        moments.add(node.connects[-1] // 500)
        node.close()
    assert len(moments) > 20


@settings(deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans(), st.floats(0.1, 40.0)), max_size=12),
)
def test_whatever_happens_the_node_is_connected_a_minute_after_everything_works_again(core, start_ms, history):
    node = Connection(core, start_ms | 1, start_ms)
    for node.network, node.broker, node.refused, seconds in history:
        node.run(seconds)
    node.network, node.broker, node.refused = True, True, False
    node.run(70)
    assert node.up
    node.close()
