"""Measures the way from many nodes' readings to the map: real broker, aggregator and map-service, the load apart.

The time of a hazard runs from its first reading, as it reached the aggregator, or from its confirmation, by the clock
of this machine, to the arrival of the map's delta at a zenoh subscriber in this process: broker, both services and the
router count. The load, the readings of many nodes and the poses of many robots, is a process of its own
(`python -m fognav_experiments.bench.pipeline`), so that no other work delays it.
"""

from __future__ import annotations

import asyncio
import math
import secrets
import socket
import sys
import threading
import time
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
import psutil
import zenoh

from fog_contracts import channels as ch
from fog_contracts.codec import decode, encode
from fog_contracts.messages import MapDelta, NodeReading, RobotPose
from fog_runtime.credentials import Credentials
from fog_runtime.transports.mqtt_connection import Broker
from fog_runtime.transports.zenoh_edge import session_config
from fognav.output import FailedError
from fognav.programs import AGGREGATOR, MAP_SERVICE, SERVERS
from fognav.stack import Stack, StackConfig, StackUsers
from fognav_experiments.bench.common import SITE, ask, make_office, write_site
from fognav_experiments.bench.foreign import Wire, foreign

if TYPE_CHECKING:
    from asyncio.subprocess import Process
    from collections.abc import AsyncIterator, Callable

    from fog_contracts.grid import StaticMap
    from fog_contracts.messages import PointXY, Trace


LARGEST_AREA: Final = 130
"""Nodes of one area, at most a third of all; the others share theirs with three more."""
BENCH: Final = "bench"
"""The user who stands for all nodes and robots."""
_AREA: Final = 4
_SIDE: Final = 1.0
"""Side of an area (m)."""
_READY_S: Final = 120.0
_POLL_S: Final = 0.5
_STILL: Final = 3
"""So many polls without another reading, and all that arrive have arrived."""
MB: Final = 1e6


class Fog:
    """The running processes of one measurement."""

    def __init__(self, stack: Stack) -> None:
        self._stack = stack
        self.processes = {name: psutil.Process(stack.pids()[name]) for name in (AGGREGATOR, MAP_SERVICE)}

    def cpu_s(self) -> dict[str, float]:
        """Return the CPU time (s) that each process has used."""
        return {name: sum(process.cpu_times()[:2]) for name, process in self.processes.items()}

    def rss_mb(self) -> dict[str, float]:
        """Return the memory of each process."""
        return {name: round(process.memory_info().rss / MB, 1) for name, process in self.processes.items()}

    async def received(self) -> int:
        """Return how many readings the aggregator has received, whether they count or not."""
        return sum(node["received"] + node["ignored"] for node in await self._list("/api/v1/nodes"))

    async def all_received(self) -> int:
        """Return the same, once none has arrived for a while."""
        received, still = await self.received(), 0
        while still < _STILL:
            await asyncio.sleep(_POLL_S)
            before, received = received, await self.received()
            still = still + 1 if received == before else 0
        return received

    async def wait_clear(self) -> None:
        """Wait until all areas are clear; raises `FailedError`."""
        for _ in range(round(_READY_S / _POLL_S)):
            if all(view["state"] == "clear" for view in await self._list("/api/v1/nodes")):
                return
            await asyncio.sleep(_POLL_S)
        raise FailedError("nodes are not clear though all measure that: this machine can't keep up")

    async def _list(self, path: str) -> list[dict[str, Any]]:
        answer = await ask(self._stack, AGGREGATOR, "GET", path)
        if not isinstance(answer.body, list):
            raise FailedError(f"the aggregator does not answer {path}: {answer.reason}")
        return answer.body


async def measure(  # noqa: PLR0913  # what is measured
    folder: Path,
    *,
    nodes: int,
    rate: float,
    robots: int,
    seconds: float,
    size: tuple[float, float] = (60.0, 40.0),
    stopped_peers: int | None = None,
    wire: Wire = "zenoh",
    on_phase: Callable[[str], object],
) -> dict[str, Any]:
    """Return the figures; times in ms, None when no hazard reached the map. `folder` is empty.

    The floor has the `size` (m). With `stopped_peers` there is a bridge to ROS 2, too, with one peer that reads, and so
    many that have stopped; `wire` says how it speaks.
    """
    centres = write_nodes(folder, nodes, size)
    users = StackUsers(site=SITE, unrestricted=(BENCH,))
    config = StackConfig(site_dir=folder, robot="none", extra={"HAZARDS_WAIT_S": "0"}, users=users)
    async with Stack(config) as stack:
        on_phase("starting broker, Redis, router, aggregator and map-service")
        await stack.start_servers(_READY_S)
        for name in (AGGREGATOR, MAP_SERVICE):
            stack.supervisor.start(name)
        await stack.supervisor.wait_ready([*SERVERS, AGGREGATOR, MAP_SERVICE], _READY_S)
        fog, traces = Fog(stack), _Traces()
        own = stack.security.credentials(BENCH)
        with zenoh.open(session_config("client", connect=[stack.zenoh_endpoint], credentials=own)) as session:
            session.declare_subscriber(ch.MAP_DELTA.key(site=SITE), traces.on_delta)
            async with AsyncExitStack() as contexts:
                load = await contexts.enter_async_context(load_generator(stack, nodes, rate, robots, seconds))
                # Kernels are loaded just then, and each node's first readings change its area.
                on_phase(f"{nodes} nodes at {rate:g} Hz, until all are clear")
                await fog.wait_clear()
                ros2 = None
                if stopped_peers is not None:
                    on_phase(f"starting the bridge to ROS 2, and {stopped_peers} peers that stop reading")
                    ros2 = await contexts.enter_async_context(foreign(stack, SITE, centres, stopped_peers, wire))
                    ros2.begin()
                on_phase(f"the same with hazards for {seconds:g} s")
                cpu, memory = fog.cpu_s(), fog.rss_mb()
                sent = await ended(load, seconds)
                cpu = {name: used - cpu[name] for name, used in fog.cpu_s().items()}
                received = await fog.all_received()
                on_mask = {} if ros2 is None else ros2.figures(traces.found, seconds)
        return {
            "sent": sent["sent"],
            "lost": sent["sent"] - received,
            "load_late_s": sent["late_s"],
            **traces.figures(),
            **on_mask,
            "aggregator_cpu_percent": round(100 * cpu[AGGREGATOR] / seconds, 1),
            "aggregator_us_per_reading": round(1e6 * cpu[AGGREGATOR] / (nodes * rate * seconds), 1),
            "map_cpu_percent": round(100 * cpu[MAP_SERVICE] / seconds, 1),
            "rss_mb_before": memory,
            "rss_mb_after": fog.rss_mb(),
        }


def write_nodes(folder: Path, nodes: int, size: tuple[float, float] = (60.0, 40.0)) -> dict[str, PointXY]:
    """Write a site with so many nodes: up to 130 of them watch one area, each four of the others another one.

    Return the middle (m) of each area.
    """
    floor = make_office(*size, seed=1)
    write_site(folder, floor)
    corners = _free_corners(floor)
    lines: list[str] = []
    centres: dict[str, PointXY] = {}
    first = min(LARGEST_AREA, max(1, nodes // 3))
    areas = ["z0"] * first + [f"z{1 + i // _AREA}" for i in range(nodes - first)]
    for index, area in enumerate(dict.fromkeys(areas)):
        x, y = corners[index % len(corners)]
        centres[area] = (x + 0.5 * _SIDE, y + 0.5 * _SIDE)
        ring = [[x, y], [x + _SIDE, y], [x + _SIDE, y + _SIDE], [x, y + _SIDE]]
        lines += ["[[areas]]", f'id = "{area}"', f"polygon = {ring}", ""]
    for index, area in enumerate(areas):
        lines += ["[[nodes]]", f'id = "n{index}"', f'area = "{area}"', f"x = {corners[0][0]}", f"y = {corners[0][1]}"]
        lines += ["theta = 1.57", "sonars = [{ range_limit = 2.65 }, { angle = 0.22, range_limit = 2.65 }]", ""]
    with (folder / "site.toml").open("a", encoding="utf-8") as file:
        file.write("\n".join(lines))
    return centres


def _free_corners(floor: StaticMap) -> list[tuple[float, float]]:
    """Return the lower left corners (m) of separate free squares: a hazard elsewhere would change no cell."""
    size = round(_SIDE / floor.geometry.resolution)
    rows, columns = (cells // size for cells in floor.cells.shape)
    squares = floor.cells[: rows * size, : columns * size].reshape(rows, size, columns, size)
    free = np.argwhere(~squares.any(axis=(1, 3)))
    left, bottom, _, _ = floor.geometry.bounds
    return [(left + float(column) * _SIDE, bottom + float(row) * _SIDE) for row, column in free]


@asynccontextmanager
async def load_generator(stack: Stack, nodes: int, rate: float, robots: int, seconds: float) -> AsyncIterator[Process]:
    """Run the load generator, which measures once it is told to."""
    asked = [nodes, rate, robots, seconds, stack.security.file(BENCH)]
    options = [SITE, stack.mqtt_url, stack.zenoh_endpoint, *map(str, asked)]
    pipe = asyncio.subprocess.PIPE
    load = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "fognav_experiments.bench.pipeline", *options, stdin=pipe, stdout=pipe, stderr=pipe
    )
    try:
        yield load
    finally:
        if load.returncode is None:
            load.kill()
            await load.wait()


async def ended(load: Process, seconds: float) -> dict[str, Any]:
    """Let the load generator measure; return what it sent. Raises `FailedError`."""
    async with asyncio.timeout(4 * seconds + 60):
        out, err = await load.communicate(b"begin\n")
    if load.returncode != 0:
        raise FailedError(f"the load generator failed: {err.decode(errors='replace').strip()[-500:]}")
    return msgspec.json.decode(out.splitlines()[-1], type=dict[str, Any])


class _Traces:
    """The hazards that reached the map, with the times (s) since their first reading and since their confirmation."""

    def __init__(self) -> None:
        self._ages: list[tuple[float, float]] = []
        self.found: list[Trace] = []

    def on_delta(self, sample: zenoh.Sample) -> None:
        """Note the hazards of a delta that has arrived; it is called on another thread."""
        now = time.time()
        delta = decode(ch.MAP_DELTA, sample.payload.to_bytes(), MapDelta)
        if delta.part == delta.parts - 1:
            confirmed = [trace for trace in delta.traces if trace.confirmed > 0]
            self.found += confirmed
            self._ages += [(now - trace.first_reading, now - trace.confirmed) for trace in confirmed]

    def figures(self) -> dict[str, Any]:
        """Return how many hazards there were, and percentiles of their times (ms)."""
        # On a machine that can't keep up, readings are too old to count, and no hazard may come of them.
        figures: dict[str, Any] = {"hazards": len(self._ages)}
        for index, name in enumerate(("reading_to_delta", "confirmed_to_delta")):
            for p in (50, 99):
                ages = [age[index] for age in self._ages]
                figures[f"{name}_p{p}_ms"] = round(1000 * float(np.percentile(ages, p)), 1) if ages else None
        return figures


BLOCKED_S: Final = 0.5
"""How long a node sees its obstacle."""
HAZARDS_HZ: Final = 5.0
_REST: Final = 20.0
"""How many obstacles come in a second, and how long (s) a node sees none in between: it would be believed to flap."""
_STRIDE: Final = 0.618
"""From one such node to the next, as a share of all nodes: they spread over the areas."""
_POSE_HZ: Final = 10.0
_BATCH: Final = 20
"""Nodes whose readings are sent together."""


def main() -> None:
    """Publish as the command line says: SITE MQTT_URL ZENOH_ENDPOINT NODES RATE ROBOTS SECONDS CREDENTIALS.

    From the first line of standard input on, so many seconds are measured: nodes see obstacles, in turn. At the end it
    writes what it has sent as one JSON object. CREDENTIALS is the file of a user who may publish all of it.
    """
    site, url, endpoint = sys.argv[1:4]
    nodes, robots, rate, seconds = int(sys.argv[4]), int(sys.argv[6]), float(sys.argv[5]), float(sys.argv[7])
    stop, begun = threading.Event(), threading.Event()
    threading.Thread(target=_await_line, args=(begun,), daemon=True).start()
    own = Credentials.read(Path(sys.argv[8]))
    with (
        _connected(url, own) as broker,
        zenoh.open(session_config("client", connect=[endpoint], credentials=own)) as session,
    ):
        poses = threading.Thread(target=_publish_poses, args=(session, site, robots, stop))
        poses.start()
        sent, late_s = _publish_readings(broker, site, nodes, rate, seconds, begun)
        stop.set()
        poses.join()
        broker.sendall(b"\xe0\x00")  # DISCONNECT
        while broker.recv(4096):  # the broker closes once it has read everything
            pass
    sys.stdout.buffer.write(msgspec.json.encode({"sent": sent, "late_s": round(late_s, 3)}) + b"\n")


def _await_line(begun: threading.Event) -> None:
    sys.stdin.readline()
    begun.set()


def _connected(url: str, credentials: Credentials) -> socket.socket:
    """Return a connection that is an MQTT 3.1.1 session (section 3.1 of its standard).

    A client library would queue what it can't send yet, and deliver it later than this process says.
    """
    server = Broker.of(url, credentials)
    broker = socket.create_connection((server.host, server.port), timeout=30.0)
    broker.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    broker = credentials.tls_context().wrap_socket(broker, server_hostname=server.host)
    login = [text.encode() for text in ("fognav-bench", server.user, server.password) if text is not None]
    words = b"".join(len(text).to_bytes(2, "big") + text for text in login)
    variable = b"\x00\x04MQTT\x04\xc2\x00\x00" + words  # a clean session; user and password follow
    broker.sendall(b"\x10" + _length(len(variable)) + variable)
    if (answer := broker.recv(4)) != b"\x20\x02\x00\x00":
        raise SystemExit(f"the broker at {url} refuses the connection: {answer.hex()}")
    return broker


def _length(size: int) -> bytes:
    """Encode a packet's remaining length: seven bits a byte, the low ones first."""
    encoded = bytearray()
    while True:
        size, digit = divmod(size, 128)
        encoded.append(digit | (0x80 if size else 0))
        if not size:
            return bytes(encoded)


def _packet(topic: bytes, payload: bytes) -> bytes:
    """Return a PUBLISH packet with quality of service 0."""
    return b"\x30" + _length(2 + len(topic) + len(payload)) + len(topic).to_bytes(2, "big") + topic + payload


def _publish_readings(
    broker: socket.socket, site: str, nodes: int, rate: float, seconds: float, begun: threading.Event
) -> tuple[int, float]:
    """Publish every node's readings, spread over each period; return how many, and how late (s) the measured ones were.

    All count that were sent, those before the measurement too.
    """
    topics = [ch.NODE_READING.key(site=site, node=f"n{i}").encode() for i in range(nodes)]
    boot = secrets.randbits(32)
    begin, late_s, seq, measured = time.monotonic(), 0.0, 0, 0
    while measured < round(seconds * rate):
        blocked = _blocked(nodes, measured / rate)
        clear, near = _payload(boot, seq, seq / rate, near=False), _payload(boot, seq, seq / rate, near=True)
        for first in range(0, nodes, _BATCH):
            due = begin + seq / rate + first / nodes / rate
            if measured:
                late_s = max(late_s, time.monotonic() - due)
            time.sleep(max(0.0, due - time.monotonic()))
            batch = range(first, min(first + _BATCH, nodes))
            broker.sendall(b"".join(_packet(topics[i], near if i in blocked else clear) for i in batch))
        seq += 1
        measured += begun.is_set()
    return seq * nodes, late_s


def _blocked(nodes: int, elapsed: float) -> set[int]:
    """Return the nodes that see an obstacle after so much of the measurement (s); the first comes after a period."""
    period = max(1.0 / HAZARDS_HZ, _REST / nodes)
    latest, duration = int(elapsed / period), math.ceil(BLOCKED_S / period)
    stride = round(_STRIDE * nodes) or 1
    return {
        index * stride % nodes
        for index in range(max(1, latest - duration), latest + 1)
        if elapsed - index * period < BLOCKED_S
    }


def _payload(boot: int, seq: int, elapsed: float, *, near: bool) -> bytes:
    """Return a reading; its ranges differ from those before, as a sonar's do."""
    measured = (0.8 if near else 2.9) + 0.001 * (seq % 7)
    reading = NodeReading(
        seq=seq,
        boot=boot,
        uptime_ms=round(1000 * elapsed),
        range_m=[measured, 2.9],
        status=["ok", "ok"],
        state="blocked" if near else "clear",
        rssi=-60,
        fw="bench",
    )
    return encode(ch.NODE_READING, reading)


def _publish_poses(session: zenoh.Session, site: str, robots: int, stop: threading.Event) -> None:
    """Publish poses behind all nodes: none explains an echo."""
    keys = [ch.ROBOT_POSE.key(site=site, robot=f"r{i}") for i in range(robots)]
    while not stop.wait(1.0 / _POSE_HZ):
        for index, key in enumerate(keys):
            pose = RobotPose(
                x=2.0 + index, y=1.0, theta=0.0, covariance=[0.01] * 9, v=0.2, w=0.0, radius=0.17, height=0.35,
                stamp=time.time(),
            )  # fmt: skip
            session.put(key, encode(ch.ROBOT_POSE, pose))


if __name__ == "__main__":
    main()
