"""The guardian: owns the base, passes on fresh commands of the agent and stops the wheels otherwise.

Started by the watchdog, which passes the open serial port (FOGNAV_BASE_FD), the pipe for the guardian's heartbeats
(FOGNAV_HEARTBEAT_FD) and a pipe that closes when the watchdog ends (FOGNAV_WATCHDOG_FD). The agent connects to the Unix
socket FOGNAV_GUARDIAN_SOCKET. While one lives, any other is refused: two that took turns would share the wheels. One
that has sent no command for a second is dropped as soon as another connects.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import msgspec

from fog_contracts.messages import SENTENCE_MAX
from fog_runtime import logs, machine
from fog_runtime.configuration.robot_file import load_robot
from fog_runtime.configuration.settings import SettingsError, load
from fog_runtime.logs import Level
from fog_runtime.machine import MachineClock, lock_memory, run_in_real_time
from robot_agent.device_signature import LISTEN_S, LineCheck
from robot_agent.guardian.core import GuardianCore, Limits, Output
from robot_agent.guardian.link import PACKET_LIMIT, WheelCommand, decode_command, encode
from robot_agent.guardian.timing import HEARTBEAT_MAX_S, UNKNOWN_S, FrameClock, Heartbeats
from robot_agent.guardian.watchdog import BAD_SETTINGS, PORT_LOST
from robot_agent.registry import make_base, signatures
from robot_agent.serial_port import Port, PortLost

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

    from fog_contracts.messages import Reason
    from fog_contracts.robot import MotionSettings
    from robot_agent.guardian.base import Attempt


class Wakeups:
    """The descriptors that are watched, each with the handler of its events."""

    def __init__(self) -> None:
        self._poll = select.poll()
        self._handlers: dict[int, Callable[[], None]] = {}

    def watch(self, descriptor: int, handler: Callable[[], None], *, input_too: bool = True) -> None:
        """Call `handler` for each input, from now on; without `input_too` only when the other end has closed."""
        self._handlers[descriptor] = handler
        self._poll.register(descriptor, select.POLLIN if input_too else 0)

    def forget(self, descriptor: int) -> None:
        """Watch a descriptor no longer."""
        self._poll.unregister(descriptor)
        del self._handlers[descriptor]

    def wait(self, real_s: float) -> None:
        """Wait for an event, `real_s` real seconds at most, and handle it."""
        for descriptor, _ in self._poll.poll(1000.0 * real_s):
            if (handler := self._handlers.get(descriptor)) is not None:  # None: closed by the handler before
                handler()


class Commands:
    """Tells whether the agent has sent something, without an exception for each time that it has not."""

    def __init__(self, agent: socket.socket) -> None:
        self._poll = select.poll()
        self._poll.register(agent, select.POLLIN)

    def pending(self) -> bool:
        """Return whether a read of the socket would not block: a packet, or the end of the link."""
        return bool(self._poll.poll(0))


RESTING_S: Final = HEARTBEAT_MAX_S
"""Period while no wheel turns; but a command of the agent is applied at once, and comes a little more often."""
AGENT_LIVES_S: Final = 1.0
"""An agent sends a command every 0.05 s, an idle one every 0.1 s; one that was silent for longer than this hangs, and
another may take its place."""
REFUSE_S: Final = 2.0
PACKETS_PER_CYCLE: Final = 64
"""Limit per cycle: a flood of packets must not block the sensors."""


class GuardianSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of the guardian (environment); the watchdog sets the descriptors."""

    base_fd: int
    heartbeat_fd: int
    watchdog_fd: int
    base_port: str = ""
    guardian_socket: str
    speed: float = 1.0
    realtime_priority: int = 10
    log_level: Level = "info"
    log_format: Literal["json", "text"] = "json"


class Guardian:
    """The loop around the core: one serial port, one agent, one watchdog."""

    def __init__(
        self, settings: GuardianSettings, core: GuardianCore, listener: socket.socket, check: LineCheck
    ) -> None:
        self._settings = settings
        self._listener = listener
        self._clock = MachineClock(settings.speed)
        self._core = core
        self._check = check
        self._port = Port.from_fd(settings.base_fd, settings.base_port or None)
        self._wakeups = Wakeups()
        self._frames = FrameClock(core.driver.timing.frame_s)
        self._moving = False
        self._agent: socket.socket | None = None
        self._commands: Commands | None = None
        self._agent_heard_at = -1.0
        self._heartbeats = Heartbeats()
        self._latched: Reason | None = None
        self._pulse: tuple[Literal["rts", "dtr"], float] | None = None
        self._corrupted = 0
        self._log = logs.get("guardian")
        self._limited_log = logs.RateLimited(self._log)
        self._signal: int | None = None
        self._ended = False

    def run(self) -> int:
        """Guard until the watchdog or a signal ends it; returns the exit code."""
        self._wakeups.watch(self._settings.watchdog_fd, self._on_watchdog_lost)
        self._wakeups.watch(self._listener.fileno(), self._accept)
        try:
            # Linux sets a port's control lines when it is opened: the base would see no edge of the first pulse.
            self._release_line()
            # Bytes that arrived before this process started are stale.
            self._port.discard_input()
            if (problem := self._wrong_device()) is not None:
                return self._refuse_port(problem)
            while not self._ended and self._signal is None:
                self._wait(self._frames.wait(self._clock.now()) if self._moving else RESTING_S)
                self._cycle()
            self._port.write(self._core.stop_command())
            self._release_line()  # in the middle of a pulse, too
        except PortLost as error:
            self._log.error("port_lost", reason=str(error))
            return PORT_LOST
        self._log.info("ended", signal=self._signal and signal.Signals(self._signal).name)
        return 0

    def _wait(self, seconds: float) -> None:
        """Wait for an event, `seconds` at most and no longer than the next heartbeat may, and handle it."""
        self._wakeups.wait(self._clock.real(self._heartbeats.wait(seconds, self._clock.now())))

    def _cycle(self) -> None:
        """Look at base and agent, and advance time."""
        if self._moving and self._agent is not None:
            self._read_agent()
        self._read_base()
        self._apply(self._core.tick(self._clock.now()))
        self._end_pulse()
        self._tell_unanswered()
        self._send_heartbeat()
        if self._core.moving != self._moving:
            self._moving = not self._moving
            self._on_motion()

    def _on_motion(self) -> None:
        """Look at the base often, or seldom again.

        Commands of the agent wake this process while the wheels rest; later they are read in each cycle. The end of the
        link wakes it always.
        """
        if self._moving:
            self._frames.begin(self._clock.now())
        if self._agent is not None:
            self._wakeups.watch(self._agent.fileno(), self._read_agent, input_too=not self._moving)

    def _wrong_device(self) -> str | None:
        """Listen until the line sounds like a known device; return the sentence for another one than the base.

        Until then nothing is written but zero speeds. The watchdog has written its stop command before.
        """
        check, until = self._check, self._clock.now() + LISTEN_S
        while not check.settled and self._clock.now() < until and self._signal is None:
            select.select((self._port,), (), (), self._clock.real(UNKNOWN_S))
            check.feed(self._port.read_available())
            self._send_heartbeat()
        return check.problem

    def _refuse_port(self, problem: str) -> int:
        """Tell agents for a while why there is no base; the watchdog opens the port again, perhaps after a re-plug."""
        self._log.error("wrong_device", reason=problem)
        until = self._clock.now() + REFUSE_S
        self._wakeups.watch(self._listener.fileno(), lambda: self._refuse_agent(problem))
        while self._clock.now() < until and not self._ended and self._signal is None:
            self._wait(RESTING_S)
            self._port.read_available()
            self._send_heartbeat()
        return PORT_LOST

    def _refuse_agent(self, problem: str) -> None:
        with suppress(BlockingIOError, ConnectionError):
            agent, _ = self._listener.accept()
            self._refuse(agent, problem[:SENTENCE_MAX])

    def end(self, signum: int, _frame: FrameType | None) -> None:
        """Finish the current cycle, stop the wheels, and end (signal handler: it may interrupt anything)."""
        self._signal = signum

    def _read_base(self) -> None:
        data, now = self._port.read_available(), self._clock.now()
        before = self._core.frames
        if data:
            self._apply(self._core.on_bytes(data, now))
        self._frames.on_look(self._core.frames - before, now)
        if self._core.corrupted != self._corrupted:
            self._corrupted = self._core.corrupted
            self._limited_log.warning("frames_corrupted", "frames_corrupted", now, total=self._corrupted)

    def _on_watchdog_lost(self) -> None:
        if self._signal is None:
            self._log.error("watchdog_lost", remedy="the watchdog ended: start it again, it starts the guardian")
        self._ended = True

    def _accept(self) -> None:
        try:
            agent, _ = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return  # it disconnected already
        agent.settimeout(0)
        now = self._clock.now()
        if self._core.unanswered is not None:
            self._refuse(agent, self._core.unanswered[:SENTENCE_MAX])
            return
        if self._agent is not None and now - self._agent_heard_at <= AGENT_LIVES_S:
            reason = "another agent is connected and drives: end one of the two"
            self._limited_log.warning("agent_refused", "agent_refused", now, reason=reason)
            self._refuse(agent, reason)
            return
        self._drop_agent(f"another agent connected, and this one has sent no command for {AGENT_LIVES_S:g} s")
        self._agent, self._agent_heard_at, self._commands = agent, now, Commands(agent)
        self._wakeups.watch(agent.fileno(), self._read_agent)
        self._log.info("agent_connected")

    def _refuse(self, agent: socket.socket, reason: str) -> None:
        agent.settimeout(0)
        with agent, suppress(BlockingIOError, ConnectionError):
            agent.send(encode(reason))
            # A command left unread would reset the link, and the reason with it.
            agent.recv(PACKET_LIMIT)

    def _read_agent(self) -> None:
        agent, commands = self._agent, self._commands
        if agent is None or commands is None:
            return  # dropped earlier in this cycle
        newest: WheelCommand | None = None
        reset = False
        for _ in range(PACKETS_PER_CYCLE):
            if not commands.pending():
                break
            try:
                data = agent.recv(PACKET_LIMIT + 1)
            except ConnectionError as error:
                self._drop_agent(str(error))
                return
            if not data:
                self._drop_agent("the agent closed the link")
                return
            try:
                newest = decode_command(data)
            except (msgspec.DecodeError, UnicodeDecodeError) as error:
                self._limited_log.warning("command_refused", "command_refused", self._clock.now(), reason=str(error))
                continue
            reset = reset or newest.reset
        if newest is not None:
            command = newest if newest.reset == reset else msgspec.structs.replace(newest, reset=reset)
            self._agent_heard_at = self._clock.now()
            self._apply(self._core.on_command(command, self._agent_heard_at))

    def _drop_agent(self, reason: str) -> None:
        if self._agent is None:
            return
        self._wakeups.forget(self._agent.fileno())
        self._agent.close()
        self._agent = self._commands = None
        self._log.warning("agent_lost", reason=reason)
        self._apply(self._core.on_agent_lost(self._clock.now()))

    def _apply(self, output: Output) -> None:
        if output.attempt is not None:
            self._revive(output.attempt)
        if output.data:
            self._port.write(output.data)
        if self._core.latched != self._latched:
            self._latched = latched = self._core.latched
            if latched is None:
                self._log.warning("fault_reset")
            else:
                self._log.warning("fault_latched", fault=latched.code, reason=str(latched))
        if self._agent is None:
            return
        for feedback in output.feedback:
            try:
                self._agent.send(encode(feedback))
            except BlockingIOError:
                # The agent does not read: it hangs, and its commands will become stale.
                break
            except ConnectionError as error:
                self._drop_agent(str(error))
                break

    def _revive(self, attempt: Attempt) -> None:
        """Pulse the base's wake-up line or change the line's rate, and tell the agent when there is no hope."""
        self._log.warning("base_silent", line=attempt.line and attempt.line.name, baud=attempt.baud)
        if attempt.baud is not None:
            self._port.set_baud(attempt.baud)
        if attempt.line is not None:
            self._port.set_line(attempt.line.name, on=True)
            self._pulse = (attempt.line.name, self._clock.now() + attempt.line.seconds)

    def _release_line(self) -> None:
        """Clear the line that wakes the base, if one is wired."""
        if (line := self._core.driver.awakening.line) is not None:
            self._port.set_line(line.name, on=False)

    def _end_pulse(self) -> None:
        if self._pulse is not None and self._clock.now() >= self._pulse[1]:
            self._port.set_line(self._pulse[0], on=False)
            self._pulse = None

    def _tell_unanswered(self) -> None:
        """End the link to an agent that would wait in vain, with the reason."""
        if self._core.unanswered is not None and self._agent is not None:
            agent = self._agent
            with suppress(BlockingIOError, ConnectionError):
                agent.send(encode(self._core.unanswered[:SENTENCE_MAX]))
            self._drop_agent(self._core.unanswered)

    def _send_heartbeat(self) -> None:
        if not self._heartbeats.is_due(self._clock.now()):
            return
        # A full pipe means that the watchdog hangs, a broken one that it ended; the other pipe reports the latter too.
        with suppress(BlockingIOError, BrokenPipeError):
            os.write(self._settings.heartbeat_fd, b".")


def _listen(path: str) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        # A guardian that was killed leaves its socket behind.
        Path(path).unlink(missing_ok=True)
        listener.bind(path)
        Path(path).chmod(0o600)
    except OSError as error:
        listener.close()
        reason = error.strerror or error
        raise SettingsError(
            f"FOGNAV_GUARDIAN_SOCKET: {path}: {reason}. Name a path of at most 100 characters in a folder that exists"
        ) from error
    listener.listen(1)
    listener.settimeout(0)
    return listener


def limits_of(motion: MotionSettings, axle_m: float) -> Limits:
    """Return the guardian's limits of a robot that may move so: a little above what its agent asks for.

    axle_m: m between the wheels. The outer wheel of a curve gains from the turn, too.
    """
    wheel = motion.acceleration_m_s2 + 0.5 * axle_m * motion.turn_acceleration_rad_s2
    return Limits(linear=round(motion.speed_m_s + 0.01, 3), acceleration=round(1.2 * wheel, 2))


def main() -> int:
    """Run one guardian for the watchdog that started it."""
    try:
        settings = load(GuardianSettings, environ=os.environ)
        robot = load_robot(os.environ)
        driver = make_base(robot)
        limits = limits_of(robot.settings.motion, driver.drive_train.axle_m)
        core = GuardianCore(driver, limits, os.urandom(8).hex())
        check = LineCheck(settings.base_port, robot.settings.base.driver, signatures())
        listener = _listen(settings.guardian_socket)
    except SettingsError as error:
        logs.configure("guardian", "info", "json")
        logs.get("guardian").error("bad_settings", reason=str(error))
        return BAD_SETTINGS
    logs.configure("guardian", settings.log_level, settings.log_format)
    guardian = Guardian(settings, core, listener, check)
    for number in machine.ENDING:
        signal.signal(number, guardian.end)
    machine.ignore_terminal_stops()
    priority = run_in_real_time(settings.realtime_priority)
    logs.get("guardian").info(
        "started", base=robot.settings.base.driver, port=settings.base_port, priority=priority, memory=lock_memory()
    )
    return guardian.run()


if __name__ == "__main__":
    sys.exit(main())
