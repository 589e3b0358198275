"""Sensors other than sonars: laser rangers behind the same seam, and quantities such as temperature and gas."""

import ctypes

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts import channels as ch
from fog_contracts.codec import decode
from fog_contracts.messages import NodeValue

OK, NO_ECHO, STUCK = 0, 1, 2
UNKNOWN, CLEAR, BLOCKED = 0, 1, 2


def ranger_sample(core, model, millimetres, code):
    found = ctypes.c_int32()
    status = core["fognav_ranger_sample"](
        int(model == "vl53l1x"), ctypes.c_uint16(millimetres), ctypes.c_uint8(code), ctypes.byref(found)
    )
    return status, found.value


@pytest.mark.parametrize(
    ("model", "millimetres", "code", "sample"),
    [
        ("vl53l0x", 850, 11, (OK, 850)),
        ("vl53l0x", 8190, 11, (NO_ECHO, 0)),
        ("vl53l0x", 8191, 4, (NO_ECHO, 0)),
        ("vl53l0x", 850, 7, (NO_ECHO, 0)),
        ("vl53l0x", 850, 2, (STUCK, 0)),
        ("vl53l0x", 5, 11, (STUCK, 0)),
        ("vl53l1x", 1350, 0, (OK, 1350)),
        ("vl53l1x", 1350, 6, (OK, 1350)),
        ("vl53l1x", 1350, 2, (NO_ECHO, 0)),
        ("vl53l1x", 1350, 7, (NO_ECHO, 0)),
        ("vl53l1x", 1350, 5, (STUCK, 0)),
        ("vl53l1x", 0, 12, (STUCK, 0)),  # a target, too weak to range
        ("vl53l1x", 0, 13, (STUCK, 0)),  # a target nearer than it can range
        ("vl53l1x", 0, 0, (STUCK, 0)),
    ],
)
def test_answer_of_a_ranger(core, model, millimetres, code, sample):
    assert ranger_sample(core, model, millimetres, code) == sample


@given(st.sampled_from(["vl53l0x", "vl53l1x"]), st.integers(0, 65_535), st.integers(0, 255))
def test_only_a_range_that_was_measured_is_one(core, model, millimetres, code):
    status, found = ranger_sample(core, model, millimetres, code)
    assert (status == OK) == (found == millimetres and found >= 20)
    assert status == OK or found == 0


class RangerNode:
    """A node with a sonar that hears nothing, where that is clear, and a ranger with a limit of 1 m."""

    def __init__(self, core):
        self._core = core
        new = core["fognav_ranger_node_new"]
        new.restype = ctypes.c_void_p
        self._node = ctypes.c_void_p(new(1000))
        self._now = 2**32 - 1_000_000

    def run(self, *, answers=True, ready=True, millimetres=0, code=0):
        status, found = ctypes.c_int32(), ctypes.c_int32()
        state = self._core["fognav_ranger_node_run"](
            self._node, ctypes.c_uint32(self._now % 2**32), 1500, int(answers), int(ready),
            ctypes.c_uint16(millimetres), ctypes.c_uint8(code), ctypes.byref(status), ctypes.byref(found),
        )  # fmt: skip
        self._now += 1_500_000
        return state, status.value, found.value

    def close(self):
        self._core["fognav_ranger_node_free"](self._node)


@pytest.fixture
def ranger_node(core):
    node = RangerNode(core)
    yield node
    node.close()


def test_ranger_measures_in_turn_with_a_sonar_and_means_the_same(ranger_node):
    assert ranger_node.run(millimetres=1500) == (CLEAR, OK, 1500)
    assert ranger_node.run(millimetres=800) == (BLOCKED, OK, 800)
    assert ranger_node.run(millimetres=0, code=4) == (UNKNOWN, NO_ECHO, 0)


@pytest.mark.parametrize("fault", [{"answers": False}, {"ready": False}])
def test_ranger_that_does_not_answer_is_stuck_and_stops_nothing(ranger_node, fault):
    assert ranger_node.run(**fault) == (UNKNOWN, STUCK, 0)
    assert ranger_node.run(millimetres=1500) == (CLEAR, OK, 1500)


class Values:
    """A node's values; their sensors answer what a test sets."""

    def __init__(self, core):
        self._core = core
        new, self._step = core["fognav_values_new"], core["fognav_values_step"]
        new.restype, self._step.restype = ctypes.c_void_p, ctypes.c_char_p
        self._values = ctypes.c_void_p(new(7))
        self._now = 2**32 - 1500

    def add(self, index, kind):
        return bool(self._core["fognav_values_add"](self._values, index, kind.encode()))

    def set(self, index, thousandths, *, answers=True):
        self._core["fognav_values_set"](self._values, index, thousandths, int(answers))

    def run(self, seconds):
        """Return what is published meanwhile."""
        messages = []
        for _ in range(round(seconds * 100)):
            self._now += 10
            text = self._step(self._values, ctypes.c_uint32(self._now % 2**32))
            if text is not None:
                messages.append(decode(ch.NODE_VALUE, text, NodeValue))
        return messages

    def close(self):
        self._core["fognav_values_free"](self._values)


@pytest.fixture
def values(core):
    made = Values(core)
    yield made
    made.close()


def test_each_value_is_published_once_a_second_with_consecutive_numbers(values):
    assert values.add(0, "temperature")
    assert values.add(1, "gas")
    values.set(0, -1250)
    values.set(1, 2_000_000)
    published = values.run(5.0)
    assert 9 <= len(published) <= 10
    assert [value.seq for value in published] == list(range(len(published)))
    assert {(value.boot, value.kind, value.value, value.unit) for value in published} == {
        (7, "temperature", -1.25, "C"), (7, "gas", 2000.0, "C"),
    }  # fmt: skip


def test_sensor_that_does_not_answer_publishes_nothing_and_hides_no_other(values):
    assert values.add(0, "temperature")
    assert values.add(1, "gas")
    values.set(0, 1, answers=False)
    assert {value.kind for value in values.run(3.0)} == {"gas"}
    values.set(0, 1)
    assert {value.kind for value in values.run(3.0)} == {"gas", "temperature"}


def test_there_is_room_for_four_values_with_the_longest_names(values):
    assert [values.add(index, "k" * 32) for index in range(5)] == [True] * 4 + [False]
    assert values.run(1.1)[0].kind == "k" * 32


def test_node_without_such_sensors_publishes_no_value(values):
    assert values.run(3.0) == []
