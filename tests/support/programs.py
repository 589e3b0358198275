"""Starts `python -m MODULE` for tests without its imports: forked from a process that has done them already.

Importing a service costs one to three seconds of a core, more than most tests need afterwards. So a run of the tests
keeps one parent for each program, which imports what the program imports, and forks when a test starts it. All workers
share it: whoever needs it first starts it, and it ends with the run. The program is a process like any other, with its
own environment, files and signals, and runs its module as `__main__`. What is true of a start alone, such as that no
kernel is compiled, is tested with `python -m`. `run` does the same for commands of `fognav`, of which the live tests
type a hundred.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import errno
import fcntl
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
import threading
import time
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from fog_supervisor import supervisor

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

RUN = os.getpid()
"""The process that runs the tests, or lets its workers run them: then the root's conftest.py names it."""
_MESSAGE_BYTES = 1 << 17
_READ_LATER = ("PYTHONPATH", "PYTHONUNBUFFERED", "PYTHONDONTWRITEBYTECODE")
"""Of Python's own variables, those that a forked program respects."""
_LOADED_BY_COMMANDS = {
    "fognav": ("fognav.commands.installed", "fognav.commands.status", "fognav.commands.zone", "fognav.commands.area",
               "fognav.commands.robot", "fognav.commands.access", "fognav.commands.node", "fognav.operate.fog")
}  # fmt: skip
"""What a program imports only once it knows its arguments."""


class Program:
    """A running program, with the part of the interface of `subprocess.Popen` that tests use."""

    def __init__(self, module: str, answers: socket.socket) -> None:
        self.module = module
        self.answers = answers
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
                selector.register(self.answers, selectors.EVENT_READ)
                if not selector.select(timeout):
                    raise subprocess.TimeoutExpired(f"python -m {self.module}", timeout or 0.0)
            self.returncode = os.waitstatus_to_exitcode(int(self.answers.recv(64)))
            self.answers.close()
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


@contextlib.contextmanager
def fork_supervised() -> Iterator[None]:
    """Let supervisors of this process fork Fognav's programs; their environment and command line show in no /proc.

    `fognav demo` and `fognav up` are processes of their own, which start theirs really unless they are told not to.
    """
    launch = supervisor.launch

    async def fork(program: supervisor.Program) -> asyncio.subprocess.Process | _Supervised:
        is_module = len(program.arguments) == 3 and program.arguments[:2] == (sys.executable, "-m")
        if not is_module or _read_at_import(program.environment) != _read_at_import(os.environ):
            return await launch(program)
        # Not on the loop's thread: it waits until the parent has its imports.
        request = program.arguments[2], program.environment, program.log
        starting = asyncio.ensure_future(asyncio.to_thread(start, *request))
        try:
            return _Supervised(await asyncio.shield(starting))
        except asyncio.CancelledError:
            ended = await starting
            ended.kill()
            with contextlib.suppress(ProcessLookupError):  # it has started none itself
                os.killpg(ended.pid, signal.SIGKILL)
            raise

    supervisor.launch = fork
    try:
        yield
    finally:
        supervisor.launch = launch


class _Supervised:
    """What a supervisor uses of `asyncio.subprocess.Process`."""

    def __init__(self, program: Program) -> None:
        self._program = program
        self.pid = program.pid

    async def wait(self) -> int:
        """Wait for its end; return the exit code, negative for a signal."""
        loop, ended = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(self._program.answers, ended.set)
        try:
            await ended.wait()
        finally:
            loop.remove_reader(self._program.answers)
        return self._program.wait()


def start(module: str, environment: Mapping[str, str], log: Path, *arguments: str, forks: bool = False) -> Program:
    """Start `python -m module`; its output is appended to `log`.

    It `forks` what it supervises, as within `fork_supervised`.
    Raises ValueError for a variable that Python or numba would have read before the fork; PYTHONPATH is respected.
    """
    with log.open("ab") as file:
        request = {
            "module": module, "environment": dict(environment), "in": str(Path.cwd()), "arguments": arguments,
            "forks": forks,
        }  # fmt: skip
        return _start(request, file, file)


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


_starting = threading.Lock()


def _start(request: Mapping[str, Any], output: IO[Any], errors: IO[Any]) -> Program:
    module, environment = request["module"], request["environment"]
    if late := _read_at_import(environment) ^ _read_at_import(os.environ):
        raise ValueError(f"{module} is forked, too late for {sorted(late)}: start it with `python -m`")
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        passed = [theirs.fileno(), output.fileno(), errors.fileno()]
        with _starting:
            parent = _parent(module)
        socket.send_fds(parent, [json.dumps(request).encode()], passed)
    return Program(module, ours)


def _read_at_import(environment: Mapping[str, str]) -> set[tuple[str, str]]:
    return {
        (name, value)
        for name, value in environment.items()
        if name.startswith(("PYTHON", "NUMBA_")) and name not in _READ_LATER
    }


@cache
def _parent(module: str) -> socket.socket:
    """Return this process's link to the parent of a program; what is started over it ends with this process."""
    name = f"\0fognav-tests-{RUN}-{module}"
    link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with Path(__file__).open("rb") as lock, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another worker connects to what listens already
        try:
            listener.bind(name)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
        else:
            listener.listen()
            # A session of its own: Ctrl-C ends pytest, whose fixtures end the programs.
            command = [sys.executable, __file__, module, str(listener.fileno()), str(RUN)]
            _started.append(
                subprocess.Popen(
                    command, pass_fds=[listener.fileno()], stdin=subprocess.DEVNULL, start_new_session=True
                )
            )
        link.connect(name)
    _links.append(link)
    return link


_links: list[socket.socket] = []
_started: list[subprocess.Popen[bytes]] = []
"""Parents that this process has started. They end after the run, which waits for none of them."""


@atexit.register
def _leave() -> None:
    for link in _links:
        link.close()
    for process in _started:
        process.returncode = 0  # else Python warns of each that it still runs


class _Parent:
    """Forks the program for each request, and reports its process id and its end; children end with who requested."""

    def __init__(self, listener: socket.socket, run: int) -> None:
        self._listener = listener
        self._run = os.pidfd_open(run)
        self._children: dict[int, tuple[int, socket.socket, socket.socket]] = {}
        """Process, where its end is reported, and who requested it, by the descriptor that tells of its end."""
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ)
        self._selector.register(self._run, selectors.EVENT_READ)

    def serve(self) -> dict[str, Any] | None:
        """Return the request in each forked child, and None in the parent after the run."""
        while True:
            for key, _ in self._selector.select():
                if key.fd == self._run:
                    return self._end(None)
                if key.fd in self._children:
                    self._report_end(key.fd)
                elif key.fileobj is self._listener:
                    self._selector.register(self._listener.accept()[0], selectors.EVENT_READ)
                elif request := self._request(key.fileobj):
                    return request

    def _request(self, link: socket.socket) -> dict[str, Any] | None:
        """Return what is requested in the forked child, and None in the parent."""
        data, descriptors, _, _ = socket.recv_fds(link, _MESSAGE_BYTES, 3)
        if data:
            return json.loads(data) if self._fork(link, *descriptors) else None
        self._selector.unregister(link)
        link.close()
        return self._end(link)

    def _fork(self, requester: socket.socket, answers: int, output: int, errors: int) -> bool:
        """Return whether this is the child."""
        if pid := os.fork():
            os.close(output)
            os.close(errors)
            link = socket.socket(fileno=answers)
            link.send(str(pid).encode())
            ended = os.pidfd_open(pid)
            self._children[ended] = pid, link, requester
            self._selector.register(ended, selectors.EVENT_READ)
            return False
        os.dup2(output, 1)
        os.dup2(errors, 2)
        for _, link, _ in self._children.values():
            link.close()
        for key in self._selector.get_map().values():
            os.close(key.fd) if isinstance(key.fileobj, int) else key.fileobj.close()
        self._selector.close()
        for descriptor in (answers, output, errors):
            os.close(descriptor)
        return True

    def _report_end(self, ended: int) -> None:
        pid, link, _ = self._children.pop(ended)
        self._selector.unregister(ended)
        os.close(ended)
        _, status = os.waitpid(pid, 0)
        with link, contextlib.suppress(BrokenPipeError):  # nobody waits for a program that has been forgotten
            link.send(str(status).encode())

    def _end(self, requester: socket.socket | None) -> None:
        """End all children, or those of a process that has ended."""
        for pid, _, by in self._children.values():
            if requester in (None, by):
                os.kill(pid, signal.SIGKILL)


def main() -> None:
    """Import what the module imports, then become the program in every forked child."""
    module, descriptor, run = sys.argv[1:]
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
    request = _Parent(socket.socket(fileno=int(descriptor)), int(run)).serve()
    if request is not None:
        environment = request["environment"]
        more = [part for part in environment.get("PYTHONPATH", "").split(os.pathsep) if part and part not in sys.path]
        sys.path[1:1] = more
        os.environ.clear()
        os.environ.update(environment)
        sys.argv[:] = [file, *request["arguments"]]
        sys.dont_write_bytecode = bool(environment.get("PYTHONDONTWRITEBYTECODE"))
        if environment.get("PYTHONUNBUFFERED"):
            sys.stdout.reconfigure(write_through=True)
        # Linux gives each session its share of the processor: in that of their parent all simulators shared one.
        os.setsid()
        os.chdir(request["in"])
        time.tzset()
        with fork_supervised() if request.get("forks") else contextlib.nullcontext():
            runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
