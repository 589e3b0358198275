"""Publishes the readings of many nodes and the poses of many robots, as a process of its own: no other work delays it.

`python -m fognav_experiments.bench.node_load SITE MQTT_URL ZENOH_ENDPOINT NODES RATE ROBOTS SECONDS [CREDENTIALS]`.
From the first line of its standard input on, so many seconds are measured: nodes see obstacles, in turn. At the end it
writes what it has sent as one JSON object. CREDENTIALS is the file of a user who may publish all of it.
"""

from __future__ import annotations

import math
import secrets
import socket
import sys
import threading
import time
from pathlib import Path
from typing import Final

import msgspec
import zenoh

from fog_contracts import channels as ch
from fog_contracts.codec import encode
from fog_contracts.messages import NodeReading, RobotPose
from fog_runtime.credentials import Credentials
from fog_runtime.transports.mqtt_connection import Broker
from fog_runtime.transports.zenoh_edge import session_config

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
    """Publish as the command line says."""
    site, url, endpoint = sys.argv[1:4]
    nodes, robots, rate, seconds = int(sys.argv[4]), int(sys.argv[6]), float(sys.argv[5]), float(sys.argv[7])
    stop, begun = threading.Event(), threading.Event()
    threading.Thread(target=_await_line, args=(begun,), daemon=True).start()
    own = Credentials.read(Path(sys.argv[8]) if len(sys.argv) > 8 else None)
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
    if server.tls:
        broker = credentials.tls_context().wrap_socket(broker, server_hostname=server.host)
    login = [text.encode() for text in (server.user, server.password) if text is not None]
    flags = (0x02 | 0xC0 * bool(login)).to_bytes()  # a clean session; user and password follow
    words = b"".join(len(text).to_bytes(2, "big") + text for text in (b"fognav-bench", *login))
    variable = b"\x00\x04MQTT\x04" + flags + b"\x00\x00" + words
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
