"""Measures the time between the heartbeats of a map, as a process of its own.

`python -m fognav_experiments.bench.heartbeats SITE ENDPOINT CREDENTIALS_FILE`. Nothing else runs in this process, so
that no other work delays what it measures. Each line on standard input ends a measurement, whose gaps (s) are written
as one JSON list.
"""

from __future__ import annotations

import itertools
import sys
import time
from pathlib import Path

import msgspec
import zenoh

from fog_contracts import channels as ch
from fog_runtime.credentials import Credentials
from fog_runtime.transports.zenoh_edge import session_config


def main() -> None:
    """Listen as the command line says, until standard input ends."""
    site, endpoint, own = sys.argv[1:]
    config = session_config("client", connect=[endpoint], credentials=Credentials.read(Path(own)))
    times: list[float] = []
    with zenoh.open(config) as session:
        session.declare_subscriber(ch.MAP_HEARTBEAT.key(site=site), lambda _: times.append(time.monotonic()))
        begin = time.monotonic()
        for _ in sys.stdin:
            end = time.monotonic()
            inside = [begin, *(at for at in times.copy() if begin < at < end), end]
            gaps = [later - earlier for earlier, later in itertools.pairwise(inside)]
            sys.stdout.buffer.write(msgspec.json.encode(gaps) + b"\n")
            sys.stdout.flush()
            begin = end


if __name__ == "__main__":
    main()
