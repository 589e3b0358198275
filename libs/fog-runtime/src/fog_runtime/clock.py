"""Injectable clocks: the system's, the same sped up, and a manual one for tests and lockstep runs."""

import asyncio
import ctypes
import math
import random
import time
import zlib
from collections import deque
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Final, Literal, Protocol, get_args

from fog_runtime.machine import MachineClock

WallClockSource = Literal["kernel", "trusted"]
_EARLIEST: Final = 1_735_689_600.0
"""2025-01-01: earlier than this software."""
_COUNTS_SUSPENSION: Final = hasattr(time, "CLOCK_BOOTTIME")
_SUSPENSION_S: Final = 0.75
"""A shorter suspension is not noticed, and counts as delay."""
_SYNCHRONIZED_S: Final = 1.0
_TIME_ERROR: Final = 5
"""What adjtimex(2) returns for a clock that nothing keeps synchronized."""
_LATENESS_SAMPLES: Final = 1000
"""Ticks over which a ticker's lateness is measured: 50 s at 20 Hz."""


class Clock(Protocol):
    """A source of time; all but `real` is in the clock's own, possibly faster, seconds."""

    @property
    def speed(self) -> float:
        """How many seconds of this clock pass in one real second."""

    @property
    def id(self) -> int:
        """Identifies what `now` counts from, among all hosts (32 bits): another one after a boot, or a suspension."""

    def now(self) -> float:
        """Monotonic seconds, for ages, periods and timeouts; the origin is arbitrary."""

    def stamp(self) -> float:
        """Seconds on a scale shared by all processes of a machine, for messages, traces and people.

        At speed 1 they count from the Unix epoch; at other speeds only differences are meaningful.
        """

    def real(self, seconds: float) -> float:
        """Real seconds that `seconds` of this clock take, for timeouts of APIs that use real time."""

    async def sleep(self, seconds: float) -> None:
        """Wait for `seconds` of this clock."""


class SystemClock(MachineClock):
    """The machine's clock, run `speed` times as fast; raises `ValueError` for a speed that is not positive."""

    def __init__(self, speed: float = 1.0) -> None:
        super().__init__(speed)
        self._boot = boot_id() or str(random.SystemRandom().getrandbits(64))
        self._suspended = 0
        self._id = self._made_id()

    @property
    def id(self) -> int:
        """The same for all processes of a host, as long as that runs without a break."""
        # The monotonic clock stands still while the host is suspended, the other one does not.
        suspended = time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic() if _COUNTS_SUSPENSION else 0.0
        if abs(suspended - self._suspended) > _SUSPENSION_S:
            self._suspended = round(suspended)
            self._id = self._made_id()
        return self._id

    def _made_id(self) -> int:
        return zlib.crc32(f"{self._boot} {self._suspended} {self.speed}".encode())

    async def sleep(self, seconds: float) -> None:
        """Wait for `seconds` of this clock."""
        await asyncio.sleep(max(0.0, self.real(seconds)))


class WallClock:
    """Tells whether the machine's time of day can be believed; raises `ValueError` for an unknown source.

    By `kernel`, it can while the kernel says that something (NTP, PTP, GNSS) keeps it synchronized; by `trusted`,
    always: for machines whose clock is kept right by other means. It never can before 2025, the time that a machine
    without a battery for its clock boots in.
    """

    def __init__(self, source: WallClockSource = "kernel") -> None:
        if source not in get_args(WallClockSource):
            raise ValueError(f"the source must be one of {', '.join(get_args(WallClockSource))}, not {source!r}")
        self._source = source
        self._known = False
        self._read_at = -_SYNCHRONIZED_S

    def synchronized(self) -> bool:
        """Whether the time of day can be believed, read at most once a second."""
        now = time.monotonic()
        if now >= self._read_at + _SYNCHRONIZED_S:
            self._read_at = now
            self._known = time.time() >= _EARLIEST and (self._source == "trusted" or _kernel_is_synchronized())
        return self._known


def _kernel_is_synchronized() -> bool:
    """Return what adjtimex(2) says; False where it can't be asked."""
    library = ctypes.CDLL(None, use_errno=True)
    # struct timex is smaller than this; with its `modes` 0 the call only reads.
    state = library.adjtimex(ctypes.create_string_buffer(512)) if hasattr(library, "adjtimex") else -1
    return 0 <= state < _TIME_ERROR


def boot_id() -> str:
    """Return what identifies the run of the monotonic clock, the same for all processes; empty where nothing does."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    except OSError:
        return ""


class Phase:
    """The common beginning of several loops' ticks: the first tick of the loop that begins first."""

    def __init__(self) -> None:
        self._origin: float | None = None

    def next_tick(self, now: float, period: float, offset: float = 0.0) -> float:
        """Return the first multiple of the period, `offset` s after the common beginning, that is not before `now`."""
        if self._origin is None:
            self._origin = now
        begin = self._origin + offset
        return begin + math.ceil((now - begin) / period) * period


class Ticker:
    """A periodic loop without drift: `async for now in Ticker(clock, period): ...`.

    Ticks lie at multiples of the period after the first. Loops of one `phase` share their ticks, so that the process is
    woken once for all of them; one with an `offset` (s) ticks that much later than the others, for work on a thread of
    its own that would compete with them for the interpreter. A tick that was missed because the body took too long is
    skipped: a burst of control cycles would act several times on the same state of the world. The period may be changed
    at any time, and counts from the next tick on.
    """

    def __init__(self, clock: Clock, period: float, phase: Phase | None = None, offset: float = 0.0) -> None:
        if period <= 0.0:
            raise ValueError(f"a period must be positive, not {period} s")
        self.clock = clock
        self.period = period
        self._phase = phase or Phase()
        self._offset = offset
        self._due_by = period
        self._rejoins = False
        self.ticks = 0
        self.late = 0
        """Ticks that were skipped, or came more than half a period after they were due."""
        self._lateness: deque[float] = deque(maxlen=_LATENESS_SAMPLES)

    @property
    def p99_s(self) -> float:
        """99th percentile of the lateness (s of the clock) of the last 1000 ticks since a `rejoin`; 0 without any."""
        if not self._lateness:
            return 0.0
        ordered = sorted(self._lateness)
        return ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))]

    async def __aiter__(self) -> AsyncIterator[float]:
        """Yield `clock.now()` at every tick, the first at once, or when the phase's next one is due."""
        due = self._first()
        while True:
            wait = due - self.clock.now()
            if wait > 0.0:
                await self.clock.sleep(wait)
            else:
                # A body that never awaits must not starve the rest of the loop.
                await asyncio.sleep(0)
            now = self.clock.now()
            self._record(now, due)
            yield now
            due = self._following(due)

    async def call(self, body: Callable[[float], object]) -> None:
        """Call a plain function with `clock.now()` at every tick until it returns True; its errors are raised.

        In the callback of the timer: it costs half of what it takes to wake a task, and the loops of one phase are
        called one after the other. Clocks without timers of their own, which are moved by hand, wake a task.
        """
        if not isinstance(self.clock, SystemClock):
            async for now in self:
                if body(now) is True:
                    return
        loop = asyncio.get_running_loop()
        end: asyncio.Future[None] = loop.create_future()
        due = self._first()
        timer: asyncio.TimerHandle | None = None

        def schedule() -> None:
            nonlocal timer
            timer = loop.call_later(self.clock.real(max(0.0, due - self.clock.now())), tick)

        def tick() -> None:
            nonlocal due
            if end.done():
                return  # cancelled, and the task has not run since
            try:
                now = self.clock.now()
                self._record(now, due)
                if body(now) is True:
                    end.set_result(None)
                    return
                due = self._following(due)
                schedule()
            except Exception as error:  # noqa: BLE001  # who awaits `end` raises it
                end.set_exception(error)

        schedule()
        try:
            await end
        finally:
            if timer is not None:
                timer.cancel()

    def held_up(self, seconds: float) -> None:
        """Count the tick that is under way as `seconds` later than it was: what it needs has come no earlier."""
        self._lateness[-1] += seconds
        if seconds > self.period / 2:
            self.late += 1

    def rejoin(self) -> None:
        """Go on with the phase's next tick after this one's body, which waits on purpose and misses none until then.

        Call it when the wait begins: from then on nothing is late, and what was late before is forgotten.
        """
        self._rejoins = True
        self._lateness.clear()

    def _first(self) -> float:
        self._rejoins = False
        self._due_by = self.period
        return self._phase.next_tick(self.clock.now(), self.period, self._offset)

    def _record(self, now: float, due: float) -> None:
        """Record a tick that was due then and comes now."""
        lateness = max(0.0, now - due)
        self.ticks += 1
        self._lateness.append(lateness)
        if lateness > self.period / 2:
            self.late += 1

    def _following(self, due: float) -> float:
        """Return when the next tick after the one of `due` is due, and count those that were missed."""
        if self._rejoins:
            return self._first()
        if self.period == self._due_by:
            due += self.period
        else:
            # A multiple of the new period, which the other loops of the phase use, too.
            due = self._phase.next_tick(due + 0.5 * min(self.period, self._due_by), self.period, self._offset)
            self._due_by = self.period
        behind = self.clock.now() - due
        if behind >= self.period:
            missed = int(behind // self.period)
            self.late += missed
            due += missed * self.period
        return due


def ticker(clock: Clock, period: float) -> Ticker:
    """Return a drift-free periodic loop with `period` in seconds of the clock."""
    return Ticker(clock, period)
