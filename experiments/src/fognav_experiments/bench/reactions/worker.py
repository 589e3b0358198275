"""`python -m fognav_experiments.bench.reactions.worker`: tries faults on one robot, as standard input names them.

One line in names a fault; one line out, of JSON, has the time of its trial, or why there is none.
"""

from __future__ import annotations

import asyncio
import inspect
import json
import sys
import time
from typing import TYPE_CHECKING, Final

from fognav_experiments.bench.reactions.faults import FAULTS, Fault
from fognav_experiments.bench.reactions.rig import Rig

if TYPE_CHECKING:
    from collections.abc import Awaitable

_BETWEEN_S: Final = 0.3
"""Time that the agent gets to notice what has ended, before it is disabled."""


async def _finished(result: Awaitable[object] | None) -> None:
    if inspect.isawaitable(result):
        await result


async def try_fault(rig: Rig, fault: Fault) -> float | None:
    """Return how long (s) after the fault the wheels were still too fast; None if they are in the end."""
    await rig.wait_driving()
    begun = time.monotonic()
    await _finished(fault.begin(rig))
    await asyncio.sleep(max(0.0, begun + fault.observed_s - time.monotonic()))
    found = rig.body.slower_after(begun, fault.speed)
    await _finished(fault.end(rig))
    await rig.revive()
    await asyncio.sleep(_BETWEEN_S)
    await rig.disable()
    return found


async def _work(seed: int) -> None:
    faults = {fault.name: fault for fault in FAULTS}
    names = asyncio.Queue[str]()
    asyncio.get_running_loop().add_reader(sys.stdin, lambda: names.put_nowait(sys.stdin.readline().strip()))
    name = await names.get()
    while name:
        try:
            async with Rig(seed) as rig:
                while name:
                    seconds = await try_fault(rig, faults[name])
                    _tell(fault=name, seconds=seconds)
                    name = await names.get()
        except* (TimeoutError, ProcessLookupError) as problems:
            # Another robot goes on with the next fault: its predecessor does not drive any more.
            _tell(fault=name, problem="; ".join(str(problem) for problem in problems.exceptions))
            seed += 1000
        name = await names.get() if name else name


def _tell(**values: object) -> None:
    sys.stdout.write(json.dumps(values) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    asyncio.run(_work(int(sys.argv[1])))
