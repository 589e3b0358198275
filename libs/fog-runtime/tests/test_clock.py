import asyncio
import os
import shutil
import subprocess
import sys
import time

import pytest
from manual_clock import ManualClock

from fog_runtime.clock import Phase, SystemClock, Ticker, ticker


async def run_ticker(clock: ManualClock, bodies: list[float], period: float = 0.1) -> list[float]:
    """Return the times of the ticks when the n-th body takes bodies[n] seconds of the clock."""
    times: list[float] = []

    async def loop() -> None:
        async for now in loop_ticker:
            times.append(now)
            if len(times) > len(bodies):
                return
            await clock.sleep(bodies[len(times) - 1])

    loop_ticker = ticker(clock, period)
    task = asyncio.create_task(loop())
    end = clock.now() + 2.0 * (len(bodies) + 1) * period + 2.0 * sum(bodies)
    while not task.done():
        for _ in range(5):
            await asyncio.sleep(0)
        if not task.done():
            assert clock.now() < end, f"the ticker has ticked {len(times)} times, {len(bodies) + 1} were due"
            clock.advance(0.005)
    await task
    return times


async def test_ticks_lie_at_multiples_of_the_period_whatever_the_body_takes():
    times = await run_ticker(ManualClock(), [0.03, 0.09, 0.0, 0.05])
    assert times == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4], abs=0.006)


async def test_missed_ticks_are_skipped_and_counted():
    clock = ManualClock()
    loop_ticker = ticker(clock, 0.25)
    times = []
    async for now in loop_ticker:
        times.append(now)
        if len(times) == 3:
            break
        clock.advance(0.875 if len(times) == 1 else 0.125)
    # The ticks at 0.25 and 0.5 are skipped, that at 0.75 is 0.125 s late, and that at 1 is on time.
    assert times == [0.0, 0.875, 1.0]
    assert loop_ticker.late == 2
    assert loop_ticker.ticks == 3


async def test_a_loop_that_has_waited_on_purpose_goes_on_with_the_next_tick_and_missed_none():
    clock = ManualClock()
    loop_ticker = ticker(clock, 0.25)
    times = []
    async for now in loop_ticker:
        times.append(now)
        if len(times) == 4:
            break
        if len(times) == 1:
            clock.advance(0.875)
            loop_ticker.rejoin()
        asyncio.get_running_loop().call_soon(clock.advance, 1.0 - 0.875 if len(times) == 1 else 0.25)
    assert times == [0.0, 1.0, 1.25, 1.5]
    assert loop_ticker.late == 0


async def test_a_loop_that_waits_on_purpose_is_not_late_and_forgets_what_was_late_before():
    clock = ManualClock()
    loop_ticker = ticker(clock, 0.25)
    async for _ in loop_ticker:
        if loop_ticker.ticks == 1:
            clock.advance(0.375)
        elif loop_ticker.ticks == 2:
            assert loop_ticker.p99_s == 0.125
            loop_ticker.rejoin()
            assert loop_ticker.p99_s == 0.0
            clock.advance(60.125)
        else:
            break
    assert loop_ticker.p99_s == 0.0


async def test_loops_of_one_phase_share_their_ticks_whenever_they_begin():
    clock, phase = ManualClock(50.0), Phase()
    assert phase.next_tick(50.0, 0.1) == 50.0
    clock.advance(0.13)
    loops = [Ticker(clock, period, phase) for period in (0.1, 0.2)]
    times: dict[float, list[float]] = {loop.period: [] for loop in loops}

    async def run(loop: Ticker) -> None:
        async for now in loop:
            times[loop.period].append(now)

    tasks = [asyncio.create_task(run(loop)) for loop in loops]
    for _ in range(50):
        for _ in range(5):
            await asyncio.sleep(0)
        clock.advance(0.01)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert times[0.1] == pytest.approx([50.2, 50.3, 50.4, 50.5, 50.6], abs=0.011)
    assert times[0.2] == times[0.1][::2]


@pytest.mark.parametrize("first", [0.0, 0.025])
async def test_a_loop_with_an_offset_ticks_that_much_after_those_of_its_phase(first):
    clock, phase = ManualClock(50.0), Phase()
    # Whichever loop asks first: the common beginning is that moment.
    assert phase.next_tick(50.0, 0.1, first) == 50.0 + first
    begin = 50.0
    assert phase.next_tick(50.13, 0.1) == pytest.approx(begin + 0.2)
    clock.advance(0.13)
    ticks = aiter(Ticker(clock, 0.2, phase, 0.025))
    for due in (begin + 0.225, begin + 0.425):
        tick = asyncio.ensure_future(anext(ticks))
        while not tick.done():
            assert clock.now() < due + 1.0, f"no tick at {due} s"
            clock.advance(0.01)
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        assert await tick == pytest.approx(due, abs=0.035)


async def test_a_function_is_called_at_the_ticks_of_its_phase_until_it_returns_true():
    clock, phase, times = SystemClock(10.0), Phase(), []
    origin = phase.next_tick(clock.now(), 0.5)

    def body(now: float) -> bool:
        times.append(now)
        return len(times) == 3

    loop_ticker = Ticker(clock, 0.5, phase, 0.1)
    await loop_ticker.call(body)
    assert loop_ticker.ticks == 3
    for number, at in enumerate(times):
        assert at >= origin + 0.1 + 0.5 * number
    await asyncio.sleep(0.1)
    assert len(times) == 3


async def test_an_error_of_a_called_function_is_raised_and_ends_its_calls():
    calls: list[float] = []

    def fail(now: float) -> None:
        calls.append(now)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await Ticker(SystemClock(), 0.01).call(fail)
    await asyncio.sleep(0.05)
    assert len(calls) == 1


async def test_a_cancelled_loop_calls_its_function_no_more():
    calls: list[float] = []
    called = asyncio.Event()

    def body(now: float) -> None:
        calls.append(now)
        called.set()

    task = asyncio.create_task(Ticker(SystemClock(), 0.01).call(body))
    await called.wait()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    made = len(calls)
    await asyncio.sleep(0.05)
    assert len(calls) == made


@pytest.mark.parametrize(("first", "then"), [(0.05, 0.1), (0.1, 0.05), (0.1, 1.0)])
async def test_another_period_keeps_to_the_ticks_that_loops_of_its_phase_have(first, then):
    clock, phase = ManualClock(50.0), Phase()
    loop_ticker, times = Ticker(clock, first, phase), []

    async def run() -> None:
        async for now in loop_ticker:
            times.append(now)
            if len(times) == 2:
                loop_ticker.period = then

    task = asyncio.create_task(run())
    for _ in range(400):
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        clock.advance(0.01)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    after = [at - 50.0 for at in times[2:]]
    assert after
    assert after == pytest.approx([round(at / then) * then for at in after], abs=0.02)
    assert loop_ticker.late == 0


async def test_p99_of_few_ticks_is_the_largest_lateness():
    clock = ManualClock()
    loop_ticker = ticker(clock, 1.0)
    assert loop_ticker.p99_s == 0.0
    async for _ in loop_ticker:
        if loop_ticker.ticks == 3:
            break
        clock.advance(1.0 if loop_ticker.ticks == 1 else 1.25)
    assert loop_ticker.p99_s == pytest.approx(0.25)
    assert loop_ticker.late == 0


async def test_fast_clock_scales_time_and_timeouts():
    clock = SystemClock(10.0)
    began, real = clock.now(), time.monotonic()
    await clock.sleep(0.5)
    spent, spent_real = clock.now() - began, time.monotonic() - real
    assert spent >= 0.5
    assert spent == pytest.approx(10 * spent_real, rel=0.2, abs=0.05)
    assert clock.real(5.0) == 0.5
    assert clock.stamp() == pytest.approx(time.time() * 10, rel=1e-6)


@pytest.mark.parametrize("speed", [0.0, -1.0, 1000.0, float("nan")])
def test_speed_out_of_range_is_refused(speed):
    with pytest.raises(ValueError, match="speed"):
        SystemClock(speed)


SLEWED = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <time.h>

// The clocks that chrony slews, at its highest rate since the computer was booted; others are as they are.
int clock_gettime(clockid_t id, struct timespec *at) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) *(void **)&real = dlsym(RTLD_NEXT, "clock_gettime");
    const int result = real(id, at);
    if (id == CLOCK_MONOTONIC || id == CLOCK_REALTIME || id == CLOCK_BOOTTIME) at->tv_sec += at->tv_sec / 12;
    return result;
}
"""


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc to build the slewed clock: apt-get install gcc")
def test_clock_of_a_process_is_not_slewed_with_the_time_of_day(tmp_path):
    source, library = tmp_path / "slewed.c", tmp_path / "slewed.so"
    source.write_text(SLEWED)
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    program = "import time; from fog_runtime.clock import SystemClock; print(time.monotonic(), SystemClock().now())"
    began = time.clock_gettime(time.CLOCK_MONOTONIC_RAW), time.monotonic()
    slewed, now = map(
        float,
        subprocess.run(
            [sys.executable, "-c", program],
            env={**os.environ, "LD_PRELOAD": str(library)},
            check=True,
            capture_output=True,
            text=True,
        ).stdout.split(),
    )
    ended = time.clock_gettime(time.CLOCK_MONOTONIC_RAW), time.monotonic()
    assert slewed > ended[1] + began[1] / 13, "the library has no effect"
    assert began[0] <= now <= ended[0]


async def test_a_tick_that_was_held_up_counts_as_late_by_as_much():
    loop_ticker = ticker(SystemClock(), period=0.2)
    loop_ticker._record(now=10.0, due=10.0)
    loop_ticker.held_up(0.09)
    assert (loop_ticker.p99_s, loop_ticker.late) == (pytest.approx(0.09), 0)
    loop_ticker._record(now=10.2, due=10.2)
    loop_ticker.held_up(0.11)
    assert (loop_ticker.p99_s, loop_ticker.late) == (pytest.approx(0.11), 1)
