"""A bridge to ROS 2 and robots of others who listen to it, for `fognav bench pipeline --ros2`.

The bridge is a process of its own, and so is each peer that has stopped reading; ROS's router and the peer that reads
are in this one, and read masks as the demo's robot of others does.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from collections import defaultdict
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import psutil
import zenoh
import zenoh.ext

from fog_supervisor import net
from fog_supervisor.supervisor import log_tail
from fognav.output import FailedError
from fognav.programs import BRIDGE, MODULES
from fognav.running_bridge import end, running_bridge, session_config
from fognav_sim.guest import Grid

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator, Mapping, Sequence

    from fog_contracts.messages import PointXY, Trace
    from fognav.stack import Stack
    from fognav_experiments.bench.foreign_dds import Reader

_READY_S: Final = 60.0
_POLL_S: Final = 0.05
_MB: Final = 1e6
_DOMAINS: Final = range(100, 230)
"""Of DDS: one for each run, so that no other is in the way."""
Wire = Literal["zenoh", "dds"]


class Foreign:
    """A peer that reads the keepout mask: when each area became blocked on it, by this machine's clock."""

    def __init__(self, process: psutil.Process, centres: Mapping[str, PointXY]) -> None:
        """`centres`: the middle (m) of each area."""
        self._process, self._centres = process, centres
        self._before: set[str] = set()
        self.masks = 0
        self._blocked: defaultdict[str, list[float]] = defaultdict(list)
        self._cpu_s = 0.0

    def on_mask(self, data: bytes) -> None:
        """Note which areas a mask blocks that the one before did not; it is called on another thread."""
        now = time.time()
        mask = Grid.decoded(data)
        blocked = {area for area, centre in self._centres.items() if mask.at(centre) > 0}
        for area in blocked - self._before:
            self._blocked[area].append(now)
        self._before = blocked
        self.masks += 1

    def begin(self) -> None:
        """Begin to measure the bridge's processor time."""
        self._cpu_s, self.masks = sum(self._process.cpu_times()[:2]), 0

    def figures(self, traces: Sequence[Trace], seconds: float) -> dict[str, Any]:
        """Return how many of these hazards reached the mask, percentiles of their times (ms), and the bridge's cost."""
        ages = list(self._ages(traces))
        figures: dict[str, Any] = {"masks": self.masks, "hazards_on_mask": len(ages)}
        for p in (50, 99, 100):
            figures[f"confirmed_to_mask_p{p}_ms"] = round(1000 * float(np.percentile(ages, p)), 1) if ages else None
        cpu = sum(self._process.cpu_times()[:2]) - self._cpu_s
        figures["bridge_cpu_percent"] = round(100 * cpu / seconds, 1)
        figures["bridge_rss_mb"] = round(self._process.memory_info().rss / _MB, 1)
        return figures

    def _ages(self, traces: Sequence[Trace]) -> Iterator[float]:
        """Yield how long (s) hazards took to their mask: each to the first time that its area became blocked."""
        for trace in traces:
            later = [at for at in self._blocked[trace.area] if at > trace.confirmed]
            others = (each.confirmed for each in traces if each.area == trace.area)
            if later and later[0] < min((at for at in others if at > trace.confirmed), default=float("inf")):
                yield later[0] - trace.confirmed


@asynccontextmanager
async def foreign(
    stack: Stack, site: str, centres: Mapping[str, PointXY], stopped: int, wire: Wire = "zenoh"
) -> AsyncIterator[Foreign]:
    """Run a bridge to ROS 2 with one peer that reads, and `stopped` ones that do not any more; raises `FailedError`.

    `centres` are those (m) of the areas. By DDS there is the one peer that reads only.
    """
    port, topic = net.free_port(), f"fognav/{site}/keepout_mask"
    key = f"0/{topic}/**"
    async with AsyncExitStack() as contexts:
        if wire == "dds":
            bridge, found, reader = await _by_dds(contexts, stack, site, centres, topic)
            assert reader is not None
            await _until_told(found, bridge, stack)
            yield found
            return
        bridge = await contexts.enter_async_context(running_bridge(stack, site, port))
        session = contexts.enter_context(zenoh.open(session_config("peer", port)))
        found = Foreign(psutil.Process(bridge.pid), centres)
        heard = zenoh.ext.declare_advanced_subscriber(  # as rmw_zenoh has them for what is latched
            session, key, lambda sample: found.on_mask(sample.payload.to_bytes()),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )  # fmt: skip
        assert heard is not None
        for _ in range(stopped):
            command = (sys.executable, "-m", "fognav_experiments.bench.foreign", str(port), key)
            peer = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
            contexts.push_async_callback(end, peer)
            assert peer.stdout is not None
            await peer.stdout.readline()
            os.kill(peer.pid, signal.SIGSTOP)
        await _until_told(found, bridge, stack)
        yield found


async def _by_dds(
    contexts: AsyncExitStack, stack: Stack, site: str, centres: Mapping[str, PointXY], topic: str
) -> tuple[asyncio.subprocess.Process, Foreign, Reader]:
    try:
        from fognav_experiments.bench import foreign_dds  # noqa: PLC0415  # an extra
    except ImportError as error:
        raise FailedError(f"--wire dds needs Cyclone DDS ({error}): pip install cyclonedds, on x86-64") from error
    domain = _DOMAINS.start + os.getpid() % len(_DOMAINS)
    settings = {"ROS2_WIRE": "dds", "ROS2_DOMAIN": str(domain)}
    os.environ["CYCLONEDDS_URI"] = foreign_dds.LOOPBACK
    bridge = await contexts.enter_async_context(running_bridge(stack, site, net.free_port(), settings))
    found = Foreign(psutil.Process(bridge.pid), centres)
    return bridge, found, foreign_dds.Reader(domain, topic, found.on_mask)


async def _until_told(found: Foreign, bridge: asyncio.subprocess.Process, stack: Stack) -> None:
    for _ in range(round(_READY_S / _POLL_S)):
        if found.masks:
            return
        if bridge.returncode is not None:
            break
        await asyncio.sleep(_POLL_S)
    log = log_tail(stack.log(BRIDGE))
    raise FailedError(f"the bridge tells ROS 2 nothing: is {MODULES[BRIDGE]} installed with its extra ros2?\n{log}")


def main() -> None:
    """Subscribe to a key of ROS's router at a port until killed: PORT KEY. Says when it has begun."""
    with zenoh.open(session_config("peer", int(sys.argv[1]))) as session:
        session.declare_subscriber(sys.argv[2], lambda _: None)
        sys.stdout.write("reads\n")
        sys.stdout.flush()
        signal.pause()


if __name__ == "__main__":
    main()
