"""The watchdog: opens the base's serial port, starts the guardian, stops the wheels when the guardian dies or hangs.

A base may keep its last velocity when its host falls silent, so this process must outlive the guardian. It does
nothing else and imports almost nothing, so that almost nothing can end it. Run it as a service; it restarts the
guardian whenever that ends. Settings: driver and port of the base in the robot file (FOGNAV_ROBOT_FILE) or in
FOGNAV_BASE and FOGNAV_BASE_PORT, FOGNAV_SPEED, and those of the guardian, which validates the whole file.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
import tomllib
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from fog_runtime import machine
from fog_runtime.configuration import parts
from fog_runtime.configuration.parts import DEFAULT_BASE
from fog_runtime.machine import ServiceManager, lock_memory, run_in_real_time
from robot_agent.device_signature import StopCommand
from robot_agent.guardian.timing import silence_limit
from robot_agent.serial_port import Port, PortLost, PortNameError, open_port, refuse_speed

if TYPE_CHECKING:
    from types import FrameType

PORT_LOST: Final = 3
"""Exit code of the guardian when the port is lost: reopen it."""
BAD_SETTINGS: Final = 78
"""Exit code of the guardian (EX_CONFIG of sysexits.h) when a restart would fail again."""
STARTUP_S: Final = 15.0
"""Real seconds until a guardian without any heartbeat is killed as hung; the wheels are at rest meanwhile."""
REPEAT_S: Final = 0.1
RESTART_S: Final = 0.3
REOPEN_S: Final = 0.1
"""A base whose adapter is lost for a moment rolls on until its port is open again: an adapter that the bus has reset is
back within half a second."""
TERMINATE_S: Final = 1.0
CHARGER_S: Final = 0.1
"""A base that sends frames has told within this time whether it is on its charger."""
REALTIME_PRIORITY: Final = 15
"""Above the guardian's 10 and the agent's 5: each must be able to act when the next one takes all the time."""

STOPS: Final = "fognav.base_stops"
"""Entry points of the stop command of each base: plain bytes in a module separate from its driver."""


MANAGER: Final = ServiceManager()


class _Terminated(Exception):  # noqa: N818  # an end, not an error
    """A signal that ends the process arrived."""


class BadSettings(Exception):  # noqa: N818  # an end, too
    """The settings are invalid: the process ends, and a restart would fail again."""


def log_event(event: str, **fields: object) -> None:
    """Write one line of JSON to standard error."""
    line = {"ts": time.time(), "process": "watchdog", "event": event, **fields}
    # A log without a reader must not end the process that stops the wheels.
    with suppress(OSError):
        sys.stderr.write(json.dumps(line) + "\n")
        sys.stderr.flush()


def _terminate(signum: int, _frame: FrameType | None) -> None:
    # A second signal must not interrupt the stop that the first one requested.
    for number in machine.ENDING:
        signal.signal(number, signal.SIG_IGN)
    raise _Terminated(signal.Signals(signum).name)


def stop_wheels(port: Port, command: bytes) -> bool:
    """Write the stop command; log and return False when the port is lost."""
    try:
        port.write(command)
    except PortLost as error:
        log_event("stop_failed", reason=str(error))
        return False
    return True


def let_charge(port: Port, base: StopCommand) -> None:
    """Let a base charge that says that it is on its charger: the last stop command may have ended that."""
    if not base.charge:
        return
    heard, until = b"", time.monotonic() + CHARGER_S
    try:
        while not base.charging(heard) and (left := until - time.monotonic()) > 0:
            select.select((port,), (), (), left)
            heard += port.read_available()
        if base.charging(heard):
            port.write(base.charge)
    except PortLost as error:
        log_event("charge_failed", reason=str(error))


def hold(port: Port, command: bytes, seconds: float) -> None:
    """Wait with the wheels held at zero: a stop may get lost on the line, and no guardian repeats it.

    Raises:
        PortLost: when the port is lost.

    """
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        port.write(command)
        time.sleep(min(left, REPEAT_S))


def _start_guardian(port: Port, heartbeat_write: int, alive_read: int) -> subprocess.Popen[bytes]:
    environment = {
        **os.environ,
        "FOGNAV_BASE_FD": str(port.fileno()),
        "FOGNAV_BASE_PORT": port.path,
        "FOGNAV_HEARTBEAT_FD": str(heartbeat_write),
        "FOGNAV_WATCHDOG_FD": str(alive_read),
    }
    return subprocess.Popen(
        [sys.executable, "-m", "robot_agent.guardian"],
        env=environment,
        pass_fds=(port.fileno(), heartbeat_write, alive_read),
        # No signal to a group reaches both processes: the one that remains stops the wheels.
        start_new_session=True,
    )


def _monitor(
    guardian: subprocess.Popen[bytes], heartbeat_read: int, port: Port, hold_command: bytes, silence_s: float
) -> str:
    """Return when the guardian has ended or hangs, with the reason; hold the wheels until its first heartbeat."""
    starts_until: float | None = time.monotonic() + STARTUP_S
    while True:
        MANAGER.alive()
        if starts_until is None:
            timeout = silence_s
        else:
            port.write(hold_command)
            timeout = REPEAT_S
        if select.select((heartbeat_read,), (), (), timeout)[0]:
            if not os.read(heartbeat_read, 4096):
                return "ended"
            starts_until = None
        elif starts_until is None or time.monotonic() > starts_until:
            guardian.kill()
            return f"hung: no heartbeat for {silence_s if starts_until is None else STARTUP_S:.3f} s, killed"


def guard_once(port: Port, base: StopCommand, silence_s: float) -> int:
    """Run the guardian until it ends or hangs; the wheels are stopped when this returns. Returns its exit code.

    Raises:
        PortLost: when the port is lost before the guardian's first heartbeat.

    """
    heartbeat_read, heartbeat_write = os.pipe()
    alive_read, alive_write = os.pipe()
    os.set_blocking(heartbeat_write, False)
    guardian = _start_guardian(port, heartbeat_write, alive_read)
    os.close(heartbeat_write)
    os.close(alive_read)
    try:
        reason = _monitor(guardian, heartbeat_read, port, base.hold, silence_s)
        stopped = stop_wheels(port, base.stop)
        code = _end(guardian)
        log_event("guardian_lost", reason=reason, exit_code=code, wheels_stopped=stopped)
        return code
    finally:
        # On a signal, end a guardian that still runs: it stops the wheels first.
        if guardian.poll() is None:
            guardian.terminate()
        os.close(alive_write)
        os.close(heartbeat_read)
        _end(guardian)
        stop_wheels(port, base.stop)


def _end(guardian: subprocess.Popen[bytes]) -> int:
    """Wait for the guardian to end; kill it after a timeout."""
    try:
        return guardian.wait(TERMINATE_S)
    except subprocess.TimeoutExpired:
        guardian.kill()
        return guardian.wait()


class Settings(NamedTuple):
    """Settings from the environment: the base's port, its stop command, simulated over wall time, and the priority."""

    path: str
    base: StopCommand
    speed: float
    realtime_priority: int


def _base() -> tuple[str, str, int | None]:
    """Return driver and port of the base, and its rate if the options name one: from variables or the robot file.

    Raises:
        BadSettings: when the file can't be read.

    """
    table: object = None
    if file := os.environ.get("FOGNAV_ROBOT_FILE"):
        try:
            with Path(file).open("rb") as opened:
                table = tomllib.load(opened).get("base")
        except (OSError, ValueError) as error:
            raise BadSettings(f"FOGNAV_ROBOT_FILE: {file}: {error}. Check it with `fognav robot check`") from error
    base = table if isinstance(table, dict) else {}
    driver = os.environ.get("FOGNAV_BASE") or base.get("driver") or DEFAULT_BASE
    port = os.environ.get("FOGNAV_BASE_PORT") or base.get("port") or ""
    options = base.get("options")
    baud = options.get("baud") if isinstance(options, dict) and driver == base.get("driver", driver) else None
    if given := os.environ.get("FOGNAV_BASE_OPTIONS"):
        with suppress(ValueError, AttributeError):  # the guardian names the mistake
            baud = json.loads(given).get("baud", baud)
    return str(driver), str(port), baud if isinstance(baud, int) else None


def read_settings() -> Settings:
    """Read the environment.

    Raises:
        BadSettings: when a variable is missing or invalid.

    """
    driver, path, baud = _base()
    if not path:
        raise BadSettings(
            "the base's serial port is not set: set `port` in [base] of the robot file, or FOGNAV_BASE_PORT, to its "
            "name in /dev/serial/by-id or /dev/serial/by-path"
        )
    try:
        speed = float(os.environ.get("FOGNAV_SPEED", "1"))
    except ValueError:
        speed = -1.0
    if not 0 < speed < 1000:
        raise BadSettings("FOGNAV_SPEED must be a positive number such as 1 (simulated over wall time)")
    try:
        base = parts.load(STOPS, driver, StopCommand)
    except parts.PartError as error:
        raise BadSettings(f"base.driver: {error}") from error
    # The guardian validates its own priority: 0 asks for none, for both.
    priority = 0 if os.environ.get("FOGNAV_REALTIME_PRIORITY") == "0" else REALTIME_PRIORITY
    return Settings(path, base if baud is None else base._replace(baud=baud), speed, priority)


def _guard(port: Port, settings: Settings) -> int:
    """Run the guardian on an open port, again after each end; returns PORT_LOST, or BAD_SETTINGS of the guardian.

    Raises:
        PortLost: when the port is lost before a guardian's first heartbeat.
        BadSettings: when this port must not be guarded at this speed.

    """
    base, speed = settings.base, settings.speed
    # Before anything else: a blocked log must not keep the wheels turning.
    stop_wheels(port, base.stop)
    if (refusal := refuse_speed(speed, port.device)) is not None:
        raise BadSettings(refusal)
    log_event("port_open", path=settings.path)
    try:
        while (code := guard_once(port, base, silence_limit(speed))) not in {PORT_LOST, BAD_SETTINGS}:
            hold(port, base.hold, RESTART_S / speed)
    except _Terminated:
        let_charge(port, base)
        raise
    return code


def _guard_always(settings: Settings) -> int:
    """Open the port and guard it, and reopen it whenever it is lost; returns BAD_SETTINGS of the guardian.

    Raises:
        BadSettings: when the port's name is refused, or its use at this speed.

    """
    last_logged = ""
    while True:
        try:
            with open_port(settings.path, settings.base.baud) as port:
                last_logged = ""
                if _guard(port, settings) == BAD_SETTINGS:
                    return BAD_SETTINGS
        except PortNameError as error:
            raise BadSettings(f"base.port: {error}") from error
        except PortLost as error:
            if str(error) != last_logged:
                last_logged = str(error)
                log_event("port_lost", reason=last_logged)
        MANAGER.alive(last_logged)
        time.sleep(REOPEN_S / settings.speed)


def _own_session() -> None:
    """Leave the session of terminal and agent: what ends or freezes their group leaves this process alone."""
    # Refused to the leader of a group, such as a job of an interactive shell or a service: it shares no group anyhow.
    with suppress(PermissionError):
        os.setsid()


def main() -> int:
    """Guard until a signal ends the process."""
    try:
        _own_session()
        machine.ignore_terminal_stops()
        settings = read_settings()
        log_event("started", priority=run_in_real_time(settings.realtime_priority), memory=lock_memory())
        for number in machine.ending():
            signal.signal(number, _terminate)
        MANAGER.ready()
        return _guard_always(settings)
    except BadSettings as error:
        log_event("bad_settings", reason=str(error))
        return BAD_SETTINGS
    except _Terminated as end:
        log_event("ended", signal=str(end))
        return 0


if __name__ == "__main__":
    sys.exit(main())
