"""`fognav record` and `fognav replay`: the channels of a running system to an MCAP file, and back."""

import asyncio
import contextlib
import signal
import time
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Final

from fog_contracts.channels import Channel
from fog_contracts.messages import Message
from fog_runtime.clock import Clock, SystemClock
from fog_runtime.mqtt_edge import MqttEdge
from fog_runtime.record import Recorder, RecordError, bytes_lost, read, record_all, replay
from fog_runtime.zenoh_edge import ZenohEdge
from fognav.output import WrongUseError

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_CONNECT_S: Final = 10.0
_POLL_S: Final = 0.05


@contextlib.asynccontextmanager
async def recording(
    path: Path, *, mqtt_url: str, zenoh: ZenohEdge, clock: Clock, numbers: Sequence[int] = ()
) -> AsyncIterator[None]:
    """Record every channel beside the body, which begins when the broker is heard.

    Raises `WrongUseError` when the file can't be written or the broker can't be reached.
    """
    mqtt = _mqtt(mqtt_url, "fognav-record", clock, zenoh.site)
    try:
        recorder = Recorder(path, site=zenoh.site)
    except OSError as error:
        raise WrongUseError(f"{path} can't be written: {error.strerror}. Name another file") from error
    with recorder:
        record_all(mqtt, zenoh, recorder, clock, numbers=numbers)
        task = asyncio.create_task(mqtt.run())
        try:
            await _connected(mqtt, mqtt_url)
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def record(path: Path, *, mqtt_url: str, zenoh_endpoint: str, site: str, seconds: float) -> dict[str, object]:
    """Record for a time (0: until a signal); return what was recorded, by channel.

    Raises `WrongUseError` without broker or router, and then leaves a file that was there before as it is.
    """
    clock = SystemClock()
    opened = ZenohEdge.open(connect=[zenoh_endpoint], clock=clock, role="console", id="record", site=site)
    async with opened as zenoh:
        await _look(zenoh, zenoh_endpoint, mqtt_url, clock)
        stop = asyncio.Event()
        for number in _SIGNALS:
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        async with recording(path, mqtt_url=mqtt_url, zenoh=zenoh, clock=clock):
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), seconds or None)
    return summary(path)


def summary(path: Path) -> dict[str, object]:
    """Return what a recording holds, and what it lost at its end; raises `WrongUseError` for a file that is none."""
    counts: dict[str, int] = {}
    first = last = 0
    try:
        for time_ns, channel, _, _ in read(path):
            counts[channel.name] = counts.get(channel.name, 0) + 1
            first = first or time_ns
            last = time_ns
        lost = bytes_lost(path)
    except OSError as error:
        raise WrongUseError(f"{path} can't be read: {error.strerror}. Name a file that was recorded") from error
    except RecordError as error:
        raise WrongUseError(f"{error}. Name a file that fognav recorded") from error
    return {
        "file": str(path),
        "messages": counts,
        "seconds": round((last - first) / 1e9, 3),
        "bytes_lost": lost,
    }


async def play(path: Path, *, mqtt_url: str, zenoh_endpoint: str, site: str, speed: float) -> dict[str, object]:
    """Send a recording's messages at their times; return how many.

    Raises `WrongUseError` for a file that is no recording or an empty one, before anything is sent, and without broker
    or router.
    """
    held = summary(path)
    if not held["messages"]:
        raise WrongUseError(f"{path} holds no whole message: there is nothing to send. Record it anew")
    clock = SystemClock(speed)
    mqtt = _mqtt(mqtt_url, "fognav-replay", clock, site)
    opened = ZenohEdge.open(connect=[zenoh_endpoint], clock=clock, role="console", id="replay", site=site)
    async with opened as zenoh:
        await _router(zenoh, zenoh_endpoint)

        async def send(channel: Channel, ids: dict[str, str], message: Message | str) -> None:
            if channel.transport == "mqtt":
                await mqtt.publish(channel, message, wait=False, **ids)
            elif isinstance(message, Message):
                zenoh.publish(channel, message, **ids)

        task = asyncio.create_task(mqtt.run())
        try:
            await _connected(mqtt, mqtt_url)
            return {"file": str(path), "sent": await replay(path, clock, send), "bytes_lost": held["bytes_lost"]}
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


def _mqtt(url: str, client: str, clock: Clock, site: str) -> MqttEdge:
    try:
        return MqttEdge(url, client, clock, site=site)
    except ValueError as error:
        raise WrongUseError(f"{url!r} names no broker ({error}). Correct --mqtt") from error


async def _look(zenoh: ZenohEdge, zenoh_endpoint: str, mqtt_url: str, clock: Clock) -> None:
    """See whether there is a system, before a file is written over; raises `WrongUseError`."""
    mqtt = _mqtt(mqtt_url, "fognav-look", clock, zenoh.site)
    looking = asyncio.create_task(mqtt.run())
    try:
        await _connected(mqtt, mqtt_url)
    finally:
        looking.cancel()
        await asyncio.gather(looking, return_exceptions=True)
    await _router(zenoh, zenoh_endpoint)


async def _connected(mqtt: MqttEdge, url: str) -> None:
    try:
        await asyncio.wait_for(mqtt.wait_connected(), _CONNECT_S)
    except TimeoutError as error:
        raise WrongUseError(
            f"the broker {url} can't be reached: start the system, or name its broker with --mqtt"
        ) from error


async def _router(zenoh: ZenohEdge, endpoint: str) -> None:
    deadline = time.monotonic() + _CONNECT_S
    while not zenoh.connected:
        if time.monotonic() > deadline:
            raise WrongUseError(
                f"the zenoh router {endpoint} can't be reached: start the system, or name its router with --zenoh, "
                "such as tcp/127.0.0.1:7447"
            )
        await asyncio.sleep(_POLL_S)
