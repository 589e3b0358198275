"""The watchdog step by step: a clock, a line and a guardian by hand, so that every byte and every moment is known.

Its real processes are in `test_processes`. Limits are literal here.
"""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from robot_agent.device_signature import StopCommand
from robot_agent.guardian import watchdog
from robot_agent.serial_port import PortLost, PortNameError

BASE = StopCommand(stop=b"stop", hold=b"hold", baud=57_600)


class Clock:
    """The modules `time` and `select` as the watchdog uses them: time passes only while it waits.

    `events` says what the heartbeat's pipe brings, wait by wait: "beat", "end", "quiet" until the timeout, or a call.
    """

    def __init__(self) -> None:
        self.now = 100.0
        self.slept: list[float] = []
        self.events: list[object] = []
        self.waits: list[float] = []
        self.guardian: Guardian | None = None

    def time(self) -> float:
        return 1_700_000_000.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0.0
        self.slept.append(round(seconds, 6))
        self._pass(seconds)

    def _pass(self, seconds: float) -> None:
        self.now = round(self.now + seconds, 9)

    def select(self, read, write, failed, timeout):
        assert (write, failed) == ((), ())
        self.waits.append(timeout)
        event = self.events.pop(0)
        if callable(event):
            event = event()
        if event == "quiet":
            self._pass(timeout)
            return [], [], []
        if event == "beat":
            os.write(self.guardian.heartbeat, b".")
            assert os.get_blocking(self.guardian.heartbeat) is False
        else:
            os.close(self.guardian.heartbeat)
        return list(read), [], []


class Line:
    """The base's line: what was written to it, and when."""

    path, device = "/dev/serial/by-id/base", "/dev/pts/7"

    def __init__(self, clock: Clock) -> None:
        self.written: list[tuple[float, bytes]] = []
        self.lost = False
        self._clock = clock

    def fileno(self) -> int:
        return 55

    def write(self, data: bytes) -> None:
        if self.lost:
            raise PortLost(self.path, "unplugged")
        self.written.append((round(self._clock.now, 6), data))

    def read_available(self) -> bytes:
        return b""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.written.append((round(self._clock.now, 6), b"closed"))


def pipe_of(descriptor: int | str) -> tuple[int, int]:
    """Return what a descriptor of this process refers to: the same for both ends of a pipe, and all copies of them."""
    status = Path(f"/proc/self/fd/{descriptor}").stat()
    return status.st_dev, status.st_ino


class Guardian:
    """A guardian that was started: its descriptors, and what was done to it. It ends when it is told to, if `obeys`."""

    def __init__(self, command, *, env, pass_fds, start_new_session) -> None:
        self.command, self.env, self.new_session = command, env, start_new_session
        self.passed = pass_fds
        self.heartbeat, self.alive = os.dup(pass_fds[1]), os.dup(pass_fds[2])
        self.pipes = {pipe_of(self.heartbeat), pipe_of(self.alive)}
        self.done: list[object] = []
        self.code: int | None = None
        self.obeys, self.exits_with = True, 0

    def poll(self) -> int | None:
        return self.code

    def terminate(self) -> None:
        self.done.append("terminate")
        if self.obeys:
            self.code = self.exits_with

    def kill(self) -> None:
        self.done.append("kill")
        self.code = -9

    def wait(self, timeout: float | None = None) -> int:
        self.done.append(timeout)
        if self.code is None:
            assert timeout is not None, "it would never end"
            raise subprocess.TimeoutExpired("guardian", timeout)
        return self.code

    def ends(self, code: int):
        """Return the event of its end."""

        def end() -> str:
            self.code = code
            return "end"

        return end

    def watchdog_is_there(self) -> bool:
        """Whether the other end of its descriptor is open: it ends when that closes."""
        os.set_blocking(self.alive, False)
        try:
            return os.read(self.alive, 1) != b""
        except BlockingIOError:
            return True


class Manager:
    def __init__(self) -> None:
        self.told: list[object] = []

    def alive(self, status: str = "") -> None:
        self.told.append(("alive", status))

    def ready(self) -> None:
        self.told.append("ready")


class Watch:
    """The watchdog's surroundings; `guardians`: those that were started."""

    def __init__(self, monkeypatch) -> None:
        self.clock, self.manager, self.log = Clock(), Manager(), io.StringIO()
        self.line = Line(self.clock)
        self.guardians: list[Guardian] = []
        self.prepare = lambda _guardian: None
        for name in ("time", "select"):
            monkeypatch.setattr(watchdog, name, self.clock)
        monkeypatch.setattr(watchdog, "MANAGER", self.manager)
        monkeypatch.setattr(watchdog.subprocess, "Popen", self._start)
        monkeypatch.setattr(watchdog, "sys", SimpleNamespace(stderr=self.log, executable=sys.executable))

    def _start(self, command, **options) -> Guardian:
        guardian = Guardian(command, **options)
        self.guardians.append(guardian)
        self.clock.guardian = guardian
        self.prepare(guardian)
        return guardian

    @property
    def events(self) -> list[dict]:
        return [json.loads(line) for line in self.log.getvalue().splitlines()]

    def guard(self, *events, silence_s=0.2, prepare=None) -> int:
        self.clock.events = list(events)
        self.prepare = prepare or self.prepare
        return watchdog.guard_once(self.line, BASE, silence_s)


@pytest.fixture
def watch(monkeypatch):
    return Watch(monkeypatch)


def lives(watch, *lives_of_guardians):
    """Let each guardian that is started live through its events: names, and at last its exit code."""
    rest = list(lives_of_guardians)

    def prepare(guardian):
        *before, code = rest.pop(0)
        watch.clock.events = [*before, guardian.ends(code)]

    watch.prepare = prepare
    return rest


# --- one guardian ---


def test_wheels_are_held_until_the_first_heartbeat_and_stopped_after_the_guardian_has_ended(watch):
    lives(watch, ["quiet", "quiet", "beat", "beat", 7])
    assert watch.guard() == 7
    assert watch.line.written == [
        (100.0, b"hold"), (100.1, b"hold"), (100.2, b"hold"), (100.2, b"stop"), (100.2, b"stop")
    ]  # fmt: skip
    assert watch.clock.waits[:3] == [0.1, 0.1, 0.1]
    assert set(watch.clock.waits[3:]) == {0.2}
    assert len(watch.manager.told) == len(watch.clock.waits)
    (lost,) = watch.events
    assert lost == {
        "ts": 1_700_000_000.0, "process": "watchdog", "event": "guardian_lost", "reason": "ended", "exit_code": 7,
        "wheels_stopped": True,
    }  # fmt: skip
    assert "kill" not in watch.guardians[0].done
    assert "terminate" not in watch.guardians[0].done


def test_silent_guardian_is_killed_at_its_limit_and_the_wheels_stop(watch):
    assert watch.guard("beat", "beat", "quiet") == -9
    assert watch.guardians[0].done[0] == "kill"
    assert watch.events[0]["reason"] == "hung: no heartbeat for 0.200 s, killed"
    assert [data for _, data in watch.line.written] == [b"hold", b"stop", b"stop"]


def test_guardian_without_any_heartbeat_is_killed_after_15_s(watch):
    assert watch.guard(*["quiet"] * 151) == -9
    assert watch.events[0]["reason"] == "hung: no heartbeat for 15.000 s, killed"
    assert watch.line.written[149:152] == [(114.9, b"hold"), (115.0, b"hold"), (115.1, b"stop")]


def test_guardian_that_closes_its_heartbeat_and_does_not_end_gets_a_second(watch):
    def closes() -> str:
        return "end"

    assert watch.guard("beat", closes) == -9
    assert watch.guardians[0].done[:3] == [1.0, "kill", None]


def test_signal_of_the_watchdog_ends_a_guardian_that_runs_and_stops_the_wheels(watch):
    def signalled() -> str:
        raise watchdog._Terminated("SIGTERM")

    with pytest.raises(watchdog._Terminated):
        watch.guard("beat", signalled)
    (guardian,) = watch.guardians
    assert guardian.done == ["terminate", 1.0]
    assert not guardian.watchdog_is_there()
    assert watch.line.written[-1][1] == b"stop"
    assert watch.events == []


def test_guardian_that_does_not_obey_a_signal_is_killed(watch):
    def signalled() -> str:
        watch.guardians[0].obeys = False
        raise watchdog._Terminated("SIGTERM")

    with pytest.raises(watchdog._Terminated):
        watch.guard("beat", signalled)
    assert watch.guardians[0].done == ["terminate", 1.0, "kill", None]


def test_port_that_is_lost_during_the_start_ends_the_guardian(watch):
    def unplugged() -> str:
        watch.line.lost = True
        return "quiet"

    with pytest.raises(PortLost):
        watch.guard(unplugged)
    assert watch.guardians[0].done[0] == "terminate"


def test_stop_that_the_port_does_not_take_is_told(watch):
    def unplugged() -> str:
        watch.line.lost = True
        watch.guardians[0].code = 3
        return "end"

    assert watch.guard("beat", unplugged) == 3
    failed, lost, _again = watch.events
    assert (failed["event"], lost["event"], lost["wheels_stopped"]) == ("stop_failed", "guardian_lost", False)
    assert "unplugged" in failed["reason"]


def test_log_without_a_reader_ends_nothing(watch, monkeypatch):
    class Gone(io.StringIO):
        def write(self, _text):
            raise BrokenPipeError

    monkeypatch.setattr(watchdog.sys, "stderr", Gone())  # the watchdog's own `sys`
    lives(watch, ["beat", 0])
    assert watch.guard() == 0


# --- guardian after guardian, port after port ---


def settings(speed=1.0, path="/dev/serial/by-id/base"):
    return watchdog.Settings(path, BASE, speed, 15)


@pytest.mark.parametrize("code", [3, 78])
def test_guardian_is_restarted_after_any_end_but_a_lost_port_and_bad_settings(watch, code):
    lives(watch, ["beat", 0], ["beat", 1], ["beat", code])
    assert watchdog._guard(watch.line, settings()) == code
    assert len(watch.guardians) == 3
    assert watch.line.written[0] == (100.0, b"stop"), "before anything else"
    assert watch.events[0]["event"] == "port_open"


def test_wheels_are_held_for_0_3_s_before_the_next_guardian_every_0_1_s(watch):
    lives(watch, ["beat", 0], ["beat", 3])
    watchdog._guard(watch.line, settings())
    stops = [number for number, (_, data) in enumerate(watch.line.written) if data == b"stop"]
    pause = watch.line.written[stops[2] + 1 : stops[3] - 1]
    assert pause == [(100.0, b"hold"), (100.1, b"hold"), (100.2, b"hold")]
    assert watch.clock.slept == [0.1, 0.1, 0.1]


def test_real_device_on_another_clock_is_refused_after_its_wheels_were_stopped(watch):
    watch.line.device = "/dev/ttyUSB0"
    with pytest.raises(watchdog.BadSettings, match="a real robot needs real time"):
        watchdog._guard(watch.line, settings(speed=2.0))
    assert [data for _, data in watch.line.written] == [b"stop"]
    assert watch.guardians == []


def opens(monkeypatch, *results):
    """Let the port be opened with these results: a line, or an exception; return what was asked for."""
    rest, asked = list(results), []

    def open_port(path, baud):
        asked.append((path, baud))
        result = rest.pop(0)
        if isinstance(result, Exception):
            raise result
        return result

    monkeypatch.setattr(watchdog, "open_port", open_port)
    return asked


def test_lost_port_is_tried_every_tenth_of_a_second_and_its_reason_told_once(watch, monkeypatch):
    lost = PortLost("base", "unplugged")
    asked = opens(monkeypatch, lost, lost, watch.line, lost, PortLost("base", "busy"), watch.line)
    lives(watch, ["beat", 3], ["beat", 78])
    assert watchdog._guard_always(settings()) == 78
    assert asked == [("/dev/serial/by-id/base", 57_600)] * 6
    told = [event["reason"].split(";")[0] for event in watch.events if event["event"] == "port_lost"]
    assert told == ["base: unplugged", "base: unplugged", "base: busy"]
    assert watch.clock.slept == [0.1] * 5
    told = [entry for entry in watch.manager.told if entry != ("alive", "")]
    assert [status.split(";")[0] for _, status in told] == [
        "base: unplugged", "base: unplugged", "base: unplugged", "base: busy"
    ]  # fmt: skip
    assert [data for _, data in watch.line.written].count(b"closed") == 2


def test_base_that_rolls_is_stopped_within_a_tenth_of_a_second_of_the_return_of_its_port(watch, monkeypatch):
    returns_at = watch.clock.now + 0.45

    def open_port(_path, _baud):
        if watch.clock.now < returns_at:
            raise PortLost("base", "no such device")
        return watch.line

    monkeypatch.setattr(watchdog, "open_port", open_port)
    lives(watch, ["beat", 78])
    watchdog._guard_always(settings())
    at, data = watch.line.written[0]
    assert data == b"stop"
    assert returns_at <= at < returns_at + 0.1


def test_name_of_a_port_that_may_change_is_refused(watch, monkeypatch):
    opens(monkeypatch, PortNameError("use its name in /dev/serial/by-id"))
    with pytest.raises(watchdog.BadSettings, match=r"base\.port: use its name"):
        watchdog._guard_always(settings())


# --- settings ---


@pytest.fixture
def environment(monkeypatch, tmp_path):
    """Return a function that sets the variables and the robot file, and reads the settings."""
    for name in list(os.environ):
        if name.startswith("FOGNAV_"):
            monkeypatch.delenv(name)

    def read(file=None, **variables):
        if file is not None:
            path = tmp_path / "robot.toml"
            path.write_text(file)
            monkeypatch.setenv("FOGNAV_ROBOT_FILE", str(path))
        for name, value in variables.items():
            monkeypatch.setenv(f"FOGNAV_{name}", value)
        return watchdog.read_settings()

    return read


FILE = '[base]\ndriver = "diffdrive"\nport = "/dev/serial/by-id/board"\noptions = { baud = 9600 }\n'


def test_settings_are_read_from_variables_alone(environment):
    read = environment(BASE_PORT="/dev/serial/by-id/base")
    assert read.path == "/dev/serial/by-id/base"
    assert (read.speed, read.realtime_priority) == (1.0, 15)
    assert read.base.baud == 115_200
    assert b"\x91\x00\x00\x00\x00" in read.base.stop, "a Roomba's zero speeds"


def test_settings_are_read_from_the_robot_file(environment):
    read = environment(FILE)
    assert (read.path, read.base.baud) == ("/dev/serial/by-id/board", 9600)
    assert b"\x91" not in read.base.stop


def test_variables_win_over_the_robot_file_and_options_of_another_base_say_nothing(environment):
    read = environment(FILE, BASE="roomba600", BASE_PORT="/dev/serial/by-id/other")
    assert (read.path, read.base.baud) == ("/dev/serial/by-id/other", 115_200)
    assert environment(FILE, BASE="roomba600", BASE_OPTIONS='{"baud": 19200}').base.baud == 19_200


def test_options_of_a_file_that_names_no_driver_are_those_of_its_base(environment):
    file = '[base]\nport = "/dev/serial/by-id/b"\noptions = { baud = 19200 }\n'
    assert environment(file).base.baud == 19_200
    assert environment('[base]\nport = "/dev/serial/by-id/b"\noptions = "none"\n').base.baud == 115_200


@pytest.mark.parametrize("options", ["no json", "[1]", '{"baud": "fast"}', "{}"])
def test_mistakes_in_the_options_are_left_to_the_guardian_to_name(environment, options):
    assert environment(BASE_PORT="/dev/serial/by-id/b", BASE_OPTIONS=options).base.baud == 115_200


def test_missing_port_and_unreadable_file_are_refused_with_the_remedy(environment, tmp_path):
    with pytest.raises(watchdog.BadSettings, match="set `port` in"):
        environment()
    with pytest.raises(watchdog.BadSettings, match="set `port` in"):
        environment("base = 1\n")
    with pytest.raises(watchdog.BadSettings, match="fognav robot check"):
        environment(ROBOT_FILE=str(tmp_path / "none"))
    with pytest.raises(watchdog.BadSettings, match="fognav robot check"):
        environment("no toml")


@pytest.mark.parametrize(("speed", "accepted"), [("0.5", True), ("999", True), ("0", False), ("1000", False),
                                                 ("-1", False), ("fast", False), ("nan", False)])  # fmt: skip
def test_speed_is_a_positive_number_below_1000(environment, speed, accepted):
    if accepted:
        assert environment(BASE_PORT="/dev/serial/by-id/b", SPEED=speed).speed == float(speed)
    else:
        with pytest.raises(watchdog.BadSettings, match="FOGNAV_SPEED must be"):
            environment(BASE_PORT="/dev/serial/by-id/b", SPEED=speed)


def test_unknown_base_is_refused_and_priority_0_asks_for_none(environment):
    with pytest.raises(watchdog.BadSettings, match=r"base\.driver: "):
        environment(BASE_PORT="/dev/serial/by-id/b", BASE="tank")
    assert environment(BASE="roomba600", REALTIME_PRIORITY="0").realtime_priority == 0
    assert environment(REALTIME_PRIORITY="7").realtime_priority == 15


# --- the process ---


@pytest.fixture
def process(watch, monkeypatch):
    """Return what the process did to its session and its signals, and the handlers that it set."""
    done, handlers = [], {}
    monkeypatch.setattr(watchdog.os, "setsid", lambda: done.append("setsid"))
    monkeypatch.setattr(watchdog.machine, "ignore_terminal_stops", lambda: done.append("ignore stops"))
    monkeypatch.setattr(watchdog.signal, "signal", lambda number, handler: handlers.update({number: handler}))
    monkeypatch.setattr(watchdog, "run_in_real_time", lambda priority: f"priority {priority}")
    monkeypatch.setattr(watchdog, "lock_memory", lambda: "locked")
    monkeypatch.setenv("FOGNAV_BASE_PORT", "/dev/serial/by-id/base")
    return done, handlers


def test_signal_ends_the_process_in_order_and_a_second_one_changes_nothing(watch, process, monkeypatch):
    _, handlers = process

    def signalled() -> str:
        handlers[signal.SIGTERM](signal.SIGTERM, None)
        raise AssertionError("the handler must not return")

    opens(monkeypatch, watch.line)
    watch.clock.events = ["beat", signalled, "quiet"]
    assert watchdog.main() == 0
    assert watch.clock.waits[-1] == pytest.approx(0.1), "a silent base tells nothing of its charger"
    assert (watch.events[-1]["event"], watch.events[-1]["signal"]) == ("ended", "SIGTERM")
    ignored = {number for number, handler in handlers.items() if handler is signal.SIG_IGN}
    assert {signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT} <= ignored
