"""What systemd does with a user's unit of `Type=notify`, for tests where it is not the first process.

    python unit_manager.py FOLDER show|daemon-reload|enable|start|restart|stop [WORDS…]     FOLDER has what runs

It runs the unit's command with its environment, and returns when that has said that it is ready, as systemctl does.
What it started ends with the process that UNIT_MANAGER_FOR names, if that is set: a test's, which may be killed.
"""

import contextlib
import os
import select
import shlex
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

READY_S = 300.0
CREDENTIALS = struct.Struct("3i")
"""Process, user and group of who says something (unix(7))."""


def unit() -> tuple[list[str], dict[str, str]]:
    """Return command and environment of the unit that `fognav up --systemd` wrote (systemd.syntax(7))."""
    lines = (Path.home() / ".config" / "systemd" / "user" / "fognav.service").read_text("utf-8").splitlines()
    (command,) = (line.removeprefix("ExecStart=") for line in lines if line.startswith("ExecStart="))
    settings = (shlex.split(line.removeprefix("Environment="))[0] for line in lines if line.startswith("Environment="))
    return shlex.split(command), dict(each.split("=", 1) for each in settings)


def stop(folder: Path) -> None:
    """End what runs, and wait for its end."""
    file = folder / "pid"
    if not file.exists():
        return
    pid = int(file.read_text())
    try:
        os.kill(pid, signal.SIGTERM)
        while True:
            os.kill(pid, 0)
            time.sleep(0.05)
    except ProcessLookupError:
        file.unlink()


def start(folder: Path) -> None:
    """Start the unit, and wait until it says that it is ready; raises `SystemExit` if it ends or says nothing."""
    command, environment = unit()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notifications, (folder / "log").open("ab") as log:
        path = folder / "notify"
        path.unlink(missing_ok=True)
        notifications.bind(str(path))
        notifications.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        notifications.settimeout(1.0)
        # A session of its own, whose parent ends with this program: nobody else waits for it.
        started = subprocess.Popen(
            command, env={**os.environ, **environment, "NOTIFY_SOCKET": str(path)}, stdin=subprocess.DEVNULL,
            stdout=log, stderr=log, start_new_session=True,
        )  # fmt: skip
        (folder / "pid").write_text(str(started.pid))
        if tests := os.environ.get("UNIT_MANAGER_FOR"):
            keeping = [sys.executable, "-S", __file__, str(folder), "keep", tests, str(started.pid)]
            subprocess.Popen(
                keeping, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log, start_new_session=True
            )
        deadline = time.monotonic() + READY_S
        while time.monotonic() < deadline:
            try:
                said, (credentials,), *_ = notifications.recvmsg(4096, socket.CMSG_SPACE(CREDENTIALS.size))
                # NotifyAccess=main: the processes that it runs have the same socket.
                if b"READY=1" in said and CREDENTIALS.unpack(credentials[2])[0] == started.pid:
                    return
            except TimeoutError:
                if started.poll() is not None:
                    break
    raise SystemExit(f"the unit did not become ready: {(folder / 'log').read_text()}")


def keep(tests: int, unit: int) -> None:
    """End a unit with the process of its tests."""
    try:
        unit_ended = os.pidfd_open(unit)
    except ProcessLookupError:  # it has ended already
        return
    with os.fdopen(unit_ended) as ended:
        try:
            with os.fdopen(os.pidfd_open(tests)) as killed:
                ready, _, _ = select.select([ended, killed], [], [])
        except ProcessLookupError:  # they are gone already
            ready = []
        if ended not in ready:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                signal.pidfd_send_signal(unit_ended, signal.SIGTERM)


def main() -> None:
    """Carry out what systemctl is told."""
    folder, words = Path(sys.argv[1]), [word for word in sys.argv[2:] if not word.startswith("-")]
    if words[:1] == ["keep"]:
        keep(int(words[1]), int(words[2]))
    if words[:1] == ["show"]:
        file = folder / "pid"
        sys.stdout.write(file.read_text() if file.exists() else "0")
    if words[:1] in (["stop"], ["restart"]):
        stop(folder)
    if words[:1] in (["start"], ["restart"]) or (words[:1] == ["enable"] and "--now" in sys.argv):
        start(folder)


if __name__ == "__main__":
    main()
