"""The machine that drives run on: what it is, the processor time that a component takes, and workers that share it."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import platform
import signal
import threading
import time
from collections import defaultdict
from concurrent import futures
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from multiprocessing.connection import wait
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from multiprocessing.connection import Connection

T = TypeVar("T")
R = TypeVar("R")


def describe() -> dict[str, object]:
    """Return the machine and the versions that a benchmark's figures depend on."""
    return {
        "machine": {
            "processor": _processor(),
            "architecture": platform.machine(),
            "cores": os.cpu_count(),
            "governor": _governor(),
            "load": round(os.getloadavg()[0], 1),
            "system": platform.platform(terse=True),
        },
        "versions": {"python": platform.python_version()} | {name: version(name) for name in ("numba", "numpy")},
    }


def sentence() -> str:
    """Return the machine in a few words, with its load."""
    load = os.getloadavg()[0]
    return f"{_processor()}, {os.cpu_count()} cores, {platform.platform(terse=True)}, load {load:.0f} at the end"


def _governor(cpu: Path = Path("/sys/devices/system/cpu/cpu0")) -> str:
    """Return what decides on the processor's clock; where the system does not tell it, as virtual machines do, so."""
    try:
        return (cpu / "cpufreq" / "scaling_governor").read_text("ascii").strip()
    except OSError:
        return "not told by the system"


def _processor() -> str:
    """Return the processor's name; an empty text where the system does not tell it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:  # noqa: PTH123  # a device of the kernel
            lines = [line for line in file if line.startswith("model name")]
    except OSError:
        return platform.processor()
    return lines[0].partition(":")[2].strip() if lines else platform.processor()


class CpuMeter:
    """Adds up CPU seconds by component. Work of a component within another's counts for the inner one only.

    Only the thread's own time counts: what other programs do meanwhile costs nothing, apart from what they take away of
    the processor's caches and clock.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._running: list[str] = []
        self._since = 0
        self._components: dict[str, _Component] = {}

    def measure(self, component: str) -> _Component:
        """Return what measures the work inside a `with` as this component's; a component may enter itself again."""
        found = self._components.get(component)
        if found is None:
            found = self._components[component] = _Component(self, component)
        return found

    def enter(self, component: str) -> None:
        """Count the time from now on for this component."""
        now = time.thread_time_ns()
        if self._running:
            self.seconds[self._running[-1]] += (now - self._since) / 1e9
        self._running.append(component)
        self._since = now

    def leave(self) -> None:
        """Count the time from now on for the component that entered this one, if any."""
        now = time.thread_time_ns()
        self.seconds[self._running.pop()] += (now - self._since) / 1e9
        self._since = now


class _Component:
    """Enters and leaves a component; one object for all its work, because there is much of it in a second."""

    __slots__ = ("_meter", "_name")

    def __init__(self, meter: CpuMeter, name: str) -> None:
        self._meter = meter
        self._name = name

    def __enter__(self) -> None:
        self._meter.enter(self._name)

    def __exit__(self, *_: object) -> None:
        self._meter.leave()


@contextmanager
def on_one_core() -> Iterator[int]:
    """Keep this thread on one core meanwhile, and give its number; workers of a pool have one each while these last."""
    allowed = os.sched_getaffinity(0)
    _, _, number = multiprocessing.current_process().name.rpartition("-")
    if number.isdigit():
        core = sorted(allowed)[int(number) % len(allowed)]
    else:  # no worker: where it runs now
        core = int(Path("/proc/thread-self/stat").read_text("ascii").rpartition(")")[2].split()[36])
    os.sched_setaffinity(0, {core})
    try:
        yield core
    finally:
        os.sched_setaffinity(0, allowed)


_NICENESS: Final = 5


@contextmanager
def open_pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Give a pool of this many fresh processes, which leave Ctrl-C to this one.

    They end even when this one is killed, and in the middle of their drives when the block is left by an exception:
    who interrupts it doesn't wait for drives that nobody records.
    """
    interrupted, interrupt = multiprocessing.Pipe(duplex=False)
    context = multiprocessing.get_context("spawn")
    with interrupted, interrupt, ProcessPoolExecutor(jobs, context, _begin, (interrupted,)) as pool:
        try:
            yield pool
        except BaseException:
            interrupt.close()
            raise


def results(drive: Callable[[T], R], tasks: Iterable[T], jobs: int) -> Iterator[R]:
    """Drive tasks, so many at a time, and yield what each gives once it ends; one at a time in this process.

    A task is taken only when it can begin: whoever gives them may end by the clock.
    """
    if jobs == 1:
        yield from map(drive, tasks)
        return
    left = iter(tasks)
    with open_pool(jobs) as pool:
        waiting = {pool.submit(drive, task) for task in itertools.islice(left, jobs)}
        while waiting:
            done, waiting = futures.wait(waiting, return_when=futures.FIRST_COMPLETED)
            for future in done:
                yield future.result()
                waiting |= {pool.submit(drive, task) for task in itertools.islice(left, 1)}


def _begin(interrupted: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(_NICENESS)
    threading.Thread(target=_end_when_alone, args=(interrupted,), name="parent's end", daemon=True).start()


def _end_when_alone(interrupted: Connection) -> None:
    """Workers share the queue of their drives, so that a worker of a killed parent would wait for the next for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "only a worker has this thread"
    wait([parent.sentinel, interrupted])
    os._exit(1)
