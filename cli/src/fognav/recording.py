"""`fognav record` and `fognav replay`: the channels of a running system to an MCAP file, and back."""

import asyncio
import contextlib
import signal
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Final

from fog_contracts.channels import Channel
from fog_contracts.messages import Message
from fog_runtime.clock import Clock, SystemClock
from fog_runtime.mqtt_edge import MqttEdge
from fog_runtime.record import Recorder, RecordError, read, record_all, replay
from fog_runtime.zenoh_edge import ZenohEdge
from fognav.output import WrongUseError

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_CONNECT_S: Final = 10.0


@contextlib.asynccontextmanager
async def recording(
    path: Path, *, mqtt_url: str, zenoh: ZenohEdge, clock: Clock, numbers: Sequence[int] = ()
) -> AsyncIterator[None]:
    """Record every channel beside the body, which begins when the broker is heard.

    Raises `WrongUseError` when the file can't be written or the broker can't be reached.
    """
    try:
        recorder = Recorder(path, site=zenoh.site)
    except OSError as error:
        raise WrongUseError(f"{path} can't be written: {error.strerror}. Name another file") from error
    with recorder:
        mqtt = MqttEdge(mqtt_url, "fognav-record", clock)
        record_all(mqtt, zenoh, recorder, clock, numbers=numbers)
        task = asyncio.create_task(mqtt.run())
        try:
            await _connected(mqtt, mqtt_url)
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def record(path: Path, *, mqtt_url: str, zenoh_endpoint: str, site: str, seconds: float) -> dict[str, object]:
    """Record for a time (0: until a signal); return what was recorded, by channel."""
    stop = asyncio.Event()
    for number in _SIGNALS:
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    clock = SystemClock()
    opened = ZenohEdge.open(connect=[zenoh_endpoint], clock=clock, role="console", id="record", site=site)
    async with opened as zenoh, recording(path, mqtt_url=mqtt_url, zenoh=zenoh, clock=clock):
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), seconds or None)
    return summary(path)


def summary(path: Path) -> dict[str, object]:
    """Return what a recording holds; raises `WrongUseError` for a file that is none."""
    counts: dict[str, int] = {}
    first = last = 0
    try:
        for time_ns, channel, _, _ in read(path):
            counts[channel.name] = counts.get(channel.name, 0) + 1
            first = first or time_ns
            last = time_ns
    except (OSError, RecordError) as error:
        raise WrongUseError(str(error)) from error
    return {"file": str(path), "messages": counts, "seconds": round((last - first) / 1e9, 3)}


async def play(path: Path, *, mqtt_url: str, zenoh_endpoint: str, site: str, speed: float) -> dict[str, object]:
    """Send a recording's messages at their times; return how many. Raises `WrongUseError` without a broker."""
    summary(path)  # a file that is no recording is refused before anything is sent
    clock = SystemClock(speed)
    mqtt = MqttEdge(mqtt_url, "fognav-replay", clock)
    opened = ZenohEdge.open(connect=[zenoh_endpoint], clock=clock, role="console", id="replay", site=site)
    async with opened as zenoh:

        async def send(channel: Channel, ids: dict[str, str], message: Message | str) -> None:
            if channel.transport == "mqtt":
                await mqtt.publish(channel, message, wait=False, **ids)
            elif isinstance(message, Message):
                zenoh.publish(channel, message, **ids)

        task = asyncio.create_task(mqtt.run())
        try:
            await _connected(mqtt, mqtt_url)
            return {"file": str(path), "sent": await replay(path, clock, send)}
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def _connected(mqtt: MqttEdge, url: str) -> None:
    try:
        await asyncio.wait_for(mqtt.wait_connected(), _CONNECT_S)
    except TimeoutError as error:
        raise WrongUseError(f"the broker {url} can't be reached: start it, or name another") from error
