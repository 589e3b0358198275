"""The compacted log: whatever is written, read and resumed, a reader ends in the log's state."""

import json

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from console_service.log import KEEP_REMOVED_S, CompactedLog, frame

EVENTS = st.sampled_from(["zone", "pose", "costmap"])
THINGS = st.sampled_from(["a", "b", "c"])
READERS = st.integers(0, 2)


class Reader:
    """A client as the console's page is one: it keeps the last state of each thing."""

    def __init__(self) -> None:
        self.state: dict[tuple[str, str], int] = {}
        self.last_id = ""
        self.position = 0
        self.connected = False
        self.revisions: list[int] = []

    def connect(self, log: CompactedLog) -> None:
        position = log.resume(self.last_id)
        if position is None:
            self.state, self.revisions = {}, []
        self.position, self.connected = position or 0, True

    def read(self, log: CompactedLog, limit: int) -> None:
        batch = log.read(self.position, limit)
        for block in batch.frames.decode().split("\n\n")[:-1]:
            fields = dict(line.split(": ", 1) for line in block.split("\n"))
            key, value = (fields["event"], json.loads(fields["data"])["id"]), json.loads(fields["data"])["value"]
            if value is None:
                self.state.pop(key, None)
            else:
                self.state[key] = value
            self.last_id = fields["id"]
            self.revisions.append(int(fields["id"].partition(".")[2]))
        self.position = batch.position


def encoded(thing: str, value: int | None) -> bytes:
    return json.dumps({"id": thing, "value": value}).encode()


class Histories(RuleBasedStateMachine):
    """Any history of writes, removals, restarts, and of three readers with any pace and breaks."""

    def __init__(self) -> None:
        super().__init__()
        self.runs, self.now = 0, 0.0
        self.readers = [Reader() for _ in range(3)]
        self.restart()

    @rule()
    def restart(self) -> None:
        self.runs += 1
        self.log = CompactedLog(f"run{self.runs}")
        self.model: dict[tuple[str, str], int] = {}
        for reader in self.readers:
            reader.connected = False

    @rule(event=EVENTS, thing=THINGS, value=st.integers(0, 3))
    def put(self, event: str, thing: str, value: int) -> None:
        changed = self.log.put(event, thing, encoded(thing, value))
        assert changed == (self.model.get((event, thing)) != value)
        self.model[event, thing] = value

    @rule(event=EVENTS, thing=THINGS)
    def remove(self, event: str, thing: str) -> None:
        removed = self.log.remove(event, thing, encoded(thing, None), self.now)
        assert removed == (self.model.pop((event, thing), None) is not None)

    @rule(seconds=st.sampled_from([1.0, KEEP_REMOVED_S / 2, KEEP_REMOVED_S]))
    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.log.prune(self.now)

    @rule(number=READERS, limit=st.sampled_from([1, 100, 10_000]))
    def read(self, number: int, limit: int) -> None:
        reader = self.readers[number]
        if reader.connected and self.log.is_lost(reader.position):
            reader.connected = False  # as the service closes its connection
        if not reader.connected:
            reader.connect(self.log)
        reader.read(self.log, limit)

    @rule(number=READERS)
    def disconnect(self, number: int) -> None:
        self.readers[number].connected = False

    @invariant()
    def revisions_rise(self) -> None:
        for reader in self.readers:
            assert reader.revisions == sorted(set(reader.revisions))

    def teardown(self) -> None:
        for number, reader in enumerate(self.readers):
            self.read(number, 10_000)
            assert reader.state == self.model


Histories.TestCase.settings = settings(max_examples=100, stateful_step_count=40, deadline=None)
TestAnyReaderEndsInTheState = Histories.TestCase


def test_what_changes_before_it_is_read_is_read_once_and_in_its_place():
    log = CompactedLog("r")
    for value in range(3):
        log.put("pose", "r1", encoded("r1", value))
        log.put("pose", "r2", encoded("r2", 0))
    assert [entry.key[1] for entry in log.after(0)] == ["r1", "r2"]
    assert log.read(0, 10_000).frames == frame("pose", encoded("r2", 0), "r.2") + frame("pose", encoded("r1", 2), "r.4")


def test_who_missed_a_removal_that_is_forgotten_or_read_another_run_begins_anew():
    log = CompactedLog("r")
    log.put("zone", "wet", encoded("wet", 1))
    position = log.read(0, 10_000).position
    log.remove("zone", "wet", encoded("wet", None), 0.0)
    assert log.resume(f"r.{position}") == position
    log.prune(KEEP_REMOVED_S)
    assert log.resume(f"r.{position}") is None
    for other in ("", "nonsense", "s.1", f"r.{log.revision + 1}", "r.-1"):
        assert log.resume(other) is None
    assert log.resume(f"r.{log.revision}") == log.revision


def test_history_that_is_forgotten_makes_nobody_begin_anew():
    log = CompactedLog("r")
    for number in range(5):
        log.put("record", str(number), b"{}")
    log.forget("record", "0")
    assert log.resume("r.1") == 1
    assert log.data("record", "0") is None
    assert log.data("record", "4") == b"{}"
