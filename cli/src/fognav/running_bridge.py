"""A bridge beside a running stack, and what it connects to (ROS's router, a fleet's broker), for demo and bench."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import sys
from contextlib import asynccontextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

import zenoh

from fog_supervisor import net
from fognav.output import WrongUseError
from fognav.programs import BRIDGE, CONSOLE, MODULES, inherited_environment

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

    from fognav.stack import Stack


GUESTS: Final = ("ros2", "rmf", "vda5050")
"""The worlds of the demo's robot of others."""


def require_ros2() -> None:
    """Raise `WrongUseError` if the bridge to ROS 2 is not installed."""
    if any(find_spec(name) is None for name in (MODULES[BRIDGE], "rosbags", "xxhash")):
        remedy = "pip install --require-hashes -r requirements/fog-bridges.txt, then the wheel of fog-bridges"
        raise WrongUseError(f"the bridge to ROS 2 is not installed: {remedy}")


def session_config(mode: str, port: int) -> zenoh.Config:
    """Return the configuration of ROS's router (`router`), or of a session as rmw_zenoh opens one (`peer`)."""
    config = zenoh.Config()
    listens = mode == "router"
    values = {
        "mode": mode, "scouting/multicast/enabled": False,
        "listen/endpoints": [f"tcp/{net.LOOPBACK}:{port}"] * listens,
        "connect/endpoints": [f"tcp/{net.LOOPBACK}:{port}"] * (not listens),
    }  # fmt: skip
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


@asynccontextmanager
async def running_bridge(
    stack: Stack, site: str, port: int, settings: Mapping[str, str] | None = None
) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run ROS's router at a port, and a bridge to it with further `settings` (FOGNAV_*, without that prefix)."""
    known = {"ADAPTERS": "ros2", "ROS2_ROUTER": f"tcp/{net.LOOPBACK}:{port}", **(settings or {})}
    with zenoh.open(session_config("router", port)):
        async with _bridge(stack, site, known) as bridge:
            yield bridge


@asynccontextmanager
async def running_vda5050(stack: Stack, site: str, port: int, robot: str, other: str) -> AsyncIterator[str]:
    """Run a fleet's broker at a port, and a bridge that tells it of `robot`, and `other` (MAKER/SERIAL) of zones.

    Yields the broker's address. Raises `WrongUseError` without Mosquitto.
    """
    if (program := shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")) is None:
        raise WrongUseError("--with vda5050 needs a broker of the fleet's own: install Mosquitto")
    broker = await asyncio.create_subprocess_exec(program, "-p", str(port), stderr=asyncio.subprocess.DEVNULL)
    url = f"mqtt://{net.LOOPBACK}:{port}"
    settings = {"ADAPTERS": "vda5050", "VDA5050_MQTT_URL": url, "VDA5050_ROBOTS": robot, "VDA5050_ZONES": other}
    try:
        async with _bridge(stack, site, settings):
            yield url
    finally:
        await end(broker)


@asynccontextmanager
async def _bridge(stack: Stack, site: str, settings: Mapping[str, str]) -> AsyncIterator[asyncio.subprocess.Process]:
    known = {
        "SITE": site, "SPEED": repr(stack.config.speed), "HTTP_PORT": "0", "MQTT_URL": stack.mqtt_url,
        "ZENOH_CONNECT": stack.zenoh_endpoint, "TOKEN_FILE": str(stack.token_file),
        "CONSOLE_URL": f"http://{net.LOOPBACK}:{stack.port(CONSOLE) or net.free_port()}",
    }  # fmt: skip
    if (credentials := stack.security.file(BRIDGE)) is not None:
        known["CREDENTIALS_FILE"] = str(credentials)
    environment = {f"FOGNAV_{name}": value for name, value in (known | dict(settings)).items()}
    command = (sys.executable, "-m", MODULES[BRIDGE])
    with stack.log(BRIDGE).open("wb") as log:
        bridge = await asyncio.create_subprocess_exec(
            *command, env=inherited_environment() | environment, stdout=log, stderr=log
        )
        try:
            yield bridge
        finally:
            await end(bridge)


async def end(process: asyncio.subprocess.Process) -> None:
    """End a process that may have ended."""
    if process.returncode is None:
        process.kill()
        await process.wait()
