"""Starts `python -m MODULE` for tests without its imports: forked from a process that has done them already.

Importing a service costs one to three seconds of a core, more than most tests need afterwards. So each pytest process
keeps one parent for each program, which imports what the program imports, and forks when a test starts it. The program
is a process like any other, with its own environment, files and signals, and runs its module as `__main__`. What is
true of a start alone, such as that no kernel is compiled, is tested with `python -m`. `run` does the same for commands
of `fognav`, of which the live tests type a hundred.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import runpy
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_MESSAGE_BYTES = 1 << 17
_LOADED_BY_COMMANDS = {
    "fognav": ("fognav.commands.installed", "fognav.commands.status", "fognav.commands.zone", "fognav.commands.area",
               "fognav.commands.robot", "fognav.commands.access", "fognav.commands.node", "fognav.operate.fog")
}  # fmt: skip
"""What a program imports only once it knows its arguments."""


class Program:
    """A running program, with the part of the interface of `subprocess.Popen` that tests use."""

    def __init__(self, module: str, answers: socket.socket) -> None:
        self.module = module
        self._answers = answers
        self.pid = int(answers.recv(64))
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal, or None while it runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; return the exit code as `poll` does, or raise `subprocess.TimeoutExpired`."""
        if self.returncode is None:
            with selectors.DefaultSelector() as selector:
                selector.register(self._answers, selectors.EVENT_READ)
                if not selector.select(timeout):
                    raise subprocess.TimeoutExpired(f"python -m {self.module}", timeout or 0.0)
            self.returncode = os.waitstatus_to_exitcode(int(self._answers.recv(64)))
            self._answers.close()
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Request its end."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it as a crash would."""
        self.send_signal(signal.SIGKILL)


def start(module: str, environment: Mapping[str, str], log: Path) -> Program:
    """Start `python -m module`; its output is appended to `log`.

    Raises ValueError for a variable that Python or numba would have read before the fork; PYTHONPATH is respected.
    """
    with log.open("ab") as file:
        return _start({"module": module, "environment": dict(environment)}, file, file)


def run(
    arguments: Sequence[str], environment: Mapping[str, str], folder: Path, timeout: float
) -> subprocess.CompletedProcess[str]:
    """Run a command of `fognav` in a folder, without anything to read; return how it ended and what it printed."""
    request = {"module": "fognav", "environment": dict(environment), "arguments": list(arguments), "in": str(folder)}
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        program = _start(request, output, errors)
        try:
            code = program.wait(timeout)
        finally:
            program.kill()
        output.seek(0)
        errors.seek(0)
        return subprocess.CompletedProcess(list(arguments), code, output.read(), errors.read())


def _start(request: Mapping[str, Any], output: IO[Any], errors: IO[Any]) -> Program:
    module, environment = request["module"], request["environment"]
    if late := _read_at_import(environment) ^ _read_at_import(os.environ):
        raise ValueError(f"{module} is forked, too late for {sorted(late)}: start it with `python -m`")
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        passed = [theirs.fileno(), output.fileno(), errors.fileno()]
        socket.send_fds(_parent(module), [json.dumps(request).encode()], passed)
    return Program(module, ours)


def _read_at_import(environment: Mapping[str, str]) -> set[tuple[str, str]]:
    return {
        (name, value)
        for name, value in environment.items()
        if name.startswith(("PYTHON", "NUMBA_")) and name != "PYTHONPATH"
    }


@cache
def _parent(module: str) -> socket.socket:
    """Return the link to the parent of this program, which ends with this process."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        # A session of its own: Ctrl-C ends pytest, whose fixtures end the programs.
        parent = subprocess.Popen(
            [sys.executable, __file__, module, str(theirs.fileno())], pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
    atexit.register(parent.wait)
    atexit.register(ours.close)  # before the wait: it is what ends the parent
    return ours


class _Parent:
    """Forks the program for each request, and reports its process id and its end; children end with it."""

    def __init__(self, requests: socket.socket) -> None:
        self._requests = requests
        self._children: dict[int, tuple[int, socket.socket]] = {}  # by the descriptor that tells of its end
        self._selector = selectors.DefaultSelector()
        self._selector.register(requests, selectors.EVENT_READ)

    def serve(self) -> dict[str, Any] | None:
        """Return the request in each forked child, and None in the parent after the last one."""
        while True:
            for key, _ in self._selector.select():
                if key.fileobj is not self._requests:
                    self._report_end(key.fd)
                    continue
                data, descriptors, _, _ = socket.recv_fds(self._requests, _MESSAGE_BYTES, 3)
                if not data:
                    return self._end()
                if self._fork(*descriptors):
                    return json.loads(data)

    def _fork(self, answers: int, output: int, errors: int) -> bool:
        """Return whether this is the child."""
        if pid := os.fork():
            os.close(output)
            os.close(errors)
            link = socket.socket(fileno=answers)
            link.send(str(pid).encode())
            ended = os.pidfd_open(pid)
            self._children[ended] = pid, link
            self._selector.register(ended, selectors.EVENT_READ)
            return False
        os.dup2(output, 1)
        os.dup2(errors, 2)
        for descriptor in (answers, output, errors, *self._children):
            os.close(descriptor)
        for _, link in self._children.values():
            link.close()
        self._selector.close()
        self._requests.close()
        return True

    def _report_end(self, ended: int) -> None:
        pid, link = self._children.pop(ended)
        self._selector.unregister(ended)
        os.close(ended)
        _, status = os.waitpid(pid, 0)
        with link, contextlib.suppress(BrokenPipeError):  # nobody waits for a program that has been forgotten
            link.send(str(status).encode())

    def _end(self) -> None:
        for pid, _ in self._children.values():
            os.kill(pid, signal.SIGKILL)


def main() -> None:
    """Import what the module imports, then become the program in every forked child."""
    module, descriptor = sys.argv[1:]
    sys.path[0] = str(Path.cwd())  # as `python -m` has it
    name = module
    if importlib.util.find_spec(module).submodule_search_locations is not None:
        name = f"{module}.__main__"
    file = importlib.import_module(name).__file__
    for more in _LOADED_BY_COMMANDS.get(module, ()):
        importlib.import_module(more)
    del sys.modules[name]  # it runs as __main__
    gc.collect()
    gc.freeze()  # shared with the children until one of them writes
    request = _Parent(socket.socket(fileno=int(descriptor))).serve()
    if request is not None:
        environment = request["environment"]
        more = [part for part in environment.get("PYTHONPATH", "").split(os.pathsep) if part and part not in sys.path]
        sys.path[1:1] = more
        os.environ.clear()
        os.environ.update(environment)
        sys.argv[:] = [file, *request.get("arguments", ())]
        os.chdir(request.get("in", "."))
        time.tzset()
        runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
