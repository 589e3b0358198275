"""The configurations of Mosquitto, Redis and the zenoh router, each written once for every way to run them.

Demonstration and tests run the servers privately on loopback ports (`fog_supervisor.servers`); the compose file runs
them in containers and mounts the files that `python -m fog_supervisor.configurations --write deploy` makes. Only
addresses, ports and folders differ: limits and durability are the same everywhere.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

MQTT_PACKET_LIMIT: Final = 256 * 1024
"""Largest MQTT packet (bytes): above every MQTT channel's limit, small enough that nobody can fill the memory."""
MQTT_QUEUE_LIMIT: Final = 10_000
"""Messages that the broker keeps for one client that is slow or away."""
MQTT_PORT: Final = 1883
REDIS_PORT: Final = 6379


_MADE: Final = "# Made by python -m fog_supervisor.configurations: change it there."
_MOSQUITTO: Final = f"""\
{_MADE}
# The broker of the sensor nodes. Retained messages are a convenience; the aggregator publishes everything again after
# each reconnect, so a lost database costs nothing.
listener {{listener}}
allow_anonymous true
persistence true
persistence_location {{data}}/
autosave_interval 30
# Larger than any message of the contracts, small enough that nobody can fill the memory.
max_packet_size {MQTT_PACKET_LIMIT}
max_queued_messages {MQTT_QUEUE_LIMIT}
# Not stdout: that is held back until a block is full.
log_dest stderr
log_type error
log_type warning
log_type notice
connection_messages false
"""
_REDIS: Final = f"""\
{_MADE}
# The record of what people and the site decide. `always` lost no acknowledged write over hundreds of kills;
# `everysec` did.
bind {{bind}}
port {{port}}
protected-mode no
appendonly yes
appendfsync always
save ""
dir "{{data}}"
maxmemory-policy noeviction
"""


def mosquitto(listener: str, data: str, *, further: Sequence[str] = ()) -> str:
    """Return a `mosquitto.conf`.

    `listener` is a port, or a port and an address; `data` the folder of the broker's database; `further` lines end the
    file.
    """
    return _MOSQUITTO.format(listener=listener, data=data) + "".join(f"{line}\n" for line in further)


def redis(bind: str, data: str, *, port: int = REDIS_PORT) -> str:
    """Return a `redis.conf` of a server whose acknowledged writes survive a crash.

    `bind` is the address on which it listens, `data` the folder of its append-only file.
    """
    return _REDIS.format(bind=bind, port=port, data=data)


def router_arguments(endpoint: str) -> list[str]:
    """Return the arguments of `python -m fog_runtime.router` that make it listen on a zenoh endpoint."""
    return ["--listen", endpoint]


def deployed() -> dict[str, str]:
    """Return the files that the compose file mounts into its servers, by their paths below `deploy/`."""
    return {
        "mosquitto/mosquitto.conf": mosquitto(str(MQTT_PORT), "/mosquitto/data"),
        "redis/redis.conf": redis("0.0.0.0", "/data"),  # noqa: S104  # inside a container; compose publishes no port
    }


def stale(folder: Path) -> list[str]:
    """Return the deployed files that are missing below `folder` or differ from `deployed`."""
    return [
        name
        for name, text in deployed().items()
        if not (folder / name).is_file() or (folder / name).read_text("utf-8") != text
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the deployed files or check them; returns 1 when a checked file is stale."""
    parser = argparse.ArgumentParser(prog="python -m fog_supervisor.configurations", description=__doc__)
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--write", type=Path, metavar="DEPLOY", help="write the files below this folder")
    action.add_argument("--check", type=Path, metavar="DEPLOY", help="say which files below this folder are stale")
    options = parser.parse_args(arguments)
    if options.write is not None:
        for name, text in deployed().items():
            (options.write / name).parent.mkdir(parents=True, exist_ok=True)
            (options.write / name).write_text(text, "utf-8")
        return 0
    for name in (old := stale(options.check)):
        sys.stdout.write(
            f"{options.check / name} is stale: run python -m fog_supervisor.configurations --write {options.check}\n"
        )
    return 1 if old else 0


if __name__ == "__main__":
    raise SystemExit(main())
