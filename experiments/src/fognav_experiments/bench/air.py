"""Measures what nodes and robots send and receive, and estimates how long that occupies a Wi-Fi channel.

Fog, simulator, robot and one node are real processes with TLS; the kernel counts the TCP segments of the node's
connection to the broker and of the robot's to the router. Each segment is a frame of its own on the air, also an
acknowledgement of TCP; what is longer here than Wi-Fi carries counts as several. The frames' times are those of IEEE
802.11n-2009 at 2.4 GHz, 20 MHz wide, short slots and one stream: clause 20.4.3 (preamble and signal extension), 9.2
(spaces and the mean of a first back-off of 15 slots), and 9.6 (an acknowledgement at the highest basic rate that is no
higher than the frame's). Left out: repeated frames, collisions, beacons, frames sent together (A-MPDU), whoever else
shares the channel, and what many robots hear more than one that is alone: changes of the map while areas change.
"""

import asyncio
import re
import subprocess
from collections.abc import Callable
from typing import Final, NamedTuple

from fog_supervisor import net
from fognav.output import WrongUseError
from fognav.programs import AGENT, SIMULATOR
from fognav_experiments.bench.robot import SETTLE_S, RobotSystem

FRAME_S: Final = (28 + 7.5 * 9 + 42 + 10) * 1e-6
"""Of one frame, without its bytes and its acknowledgement: space, back-off, preamble and short space."""
FRAME_BYTES: Final = 20 + 32 + 8 + 26 + 16 + 4
"""IP, TCP with stamps, LLC/SNAP, MAC with QoS, CCMP, checksum."""
RATES: Final = {"near": 65e6, "far": 6.5e6}
"""Bits per second: a node beside its access point, and one at the edge of its range (MCS 7 and 0)."""
ACKNOWLEDGED_S: Final = {65e6: 34e-6, 6.5e6: 50e-6}
"""How long an acknowledgement takes for a frame at these rates: at 24 and at 6 Mbit/s."""
SEGMENT_BYTES: Final = 1448
_COUNTED: Final = ("segs_out", "segs_in", "data_segs_out", "data_segs_in", "bytes_sent", "bytes_received")
NODES: Final = (7, 50, 500)
ROBOTS: Final = 5
READINGS_HZ: Final = {"idle": 1.0, "changing": 10.0}
"""How often a node sends its readings while nothing changes, and at most (docs/channels.md)."""


class Traffic(NamedTuple):
    """What one side of connections counted: segments and bytes of TCP, of both directions."""

    segments: int
    bytes: int

    def __sub__(self, before: "Traffic") -> "Traffic":
        return Traffic(self.segments - before.segments, self.bytes - before.bytes)

    def airtime_s(self, rate: float) -> float:
        """Return how long (s) these frames occupy a channel at one of the `RATES`."""
        frame_s = FRAME_S + ACKNOWLEDGED_S[rate] + 8 * FRAME_BYTES / rate
        return self.segments * frame_s + 8 * self.bytes / rate


def traffic(pid: int, port: int) -> Traffic:
    """Return what a process's connections to a port of this machine have carried so far.

    Raises `WrongUseError` where the program `ss` is missing, and `RuntimeError` without such a connection.
    """
    command = ["ss", "-HOtinp", "state", "established", "dst", f"{net.LOOPBACK}:{port}"]
    try:
        listed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    except FileNotFoundError:
        raise WrongUseError("bench air: the program ss is missing: apt-get install iproute2") from None
    lines = [line for line in listed.splitlines() if f"pid={pid}," in line]
    if not lines:
        raise RuntimeError(f"process {pid} has no connection to port {port}")
    counts = [{name: int(value) for name, value in re.findall(r"(\w+):(\d+)", line)} for line in lines]
    total = {name: sum(count.get(name, 0) for count in counts) for name in _COUNTED}
    segments = total["segs_out"] + total["segs_in"]
    data, carried = total["data_segs_out"] + total["data_segs_in"], total["bytes_sent"] + total["bytes_received"]
    return Traffic(segments + max(0, carried // SEGMENT_BYTES - data), carried)


def measure(seconds: float, on_phase: Callable[[str], object]) -> dict[str, object]:
    """Return the figures of a node and a robot, each phase measured for `seconds`, and of many of them."""
    return asyncio.run(_measure(seconds, on_phase))


async def _measure(seconds: float, on_phase: Callable[[str], object]) -> dict[str, object]:
    on_phase("starting fog, simulator and robot")
    async with RobotSystem(lambda _pid: None, node=True) as system:
        await system.wait_enabled()
        on_phase("standing by")
        node, standing_by = await _carried(system, seconds)
        await system.start_drive()
        on_phase("driving")
        _, driving = await _carried(system, seconds)
    figures: dict[str, object] = {
        "node_idle": _per_s(node, seconds),
        "robot_standing_by": _per_s(standing_by, seconds),
        "robot_driving": _per_s(driving, seconds),
    }
    for place, rate in RATES.items():
        message_s = node.airtime_s(rate) / (seconds * READINGS_HZ["idle"])
        robots_s = ROBOTS * driving.airtime_s(rate) / seconds
        figures[f"channel_percent_{place}"] = {
            f"{nodes} nodes, {ROBOTS} robots": {
                state: round(100.0 * (nodes * hz * message_s + robots_s), 2) for state, hz in READINGS_HZ.items()
            }
            for nodes in NODES
        }
    return figures


def _per_s(carried: Traffic, seconds: float) -> dict[str, float]:
    airtime = {f"airtime_{place}_ms_per_s": 1000 * carried.airtime_s(rate) / seconds for place, rate in RATES.items()}
    counted = {"frames_per_s": carried.segments / seconds, "bytes_per_s": carried.bytes / seconds}
    return {name: round(value, 2) for name, value in (counted | airtime).items()}


async def _carried(system: RobotSystem, seconds: float) -> tuple[Traffic, Traffic]:
    """Return what the node and the robot carry in this time."""
    stack = system.stack
    connections = ((SIMULATOR, stack.mqtt_port), (AGENT, stack.zenoh_port))
    await asyncio.sleep(SETTLE_S)
    before = [traffic(stack.pids()[program], port) for program, port in connections]
    await asyncio.sleep(seconds)
    node, robot = (
        traffic(stack.pids()[program], port) - then for (program, port), then in zip(connections, before, strict=True)
    )
    return node, robot
