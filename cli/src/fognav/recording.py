"""`fognav record` and `fognav replay`: channels of a running system to an MCAP file, and back."""

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
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.record import Recorder, RecordError, bytes_lost, read, record_all, replay
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fognav.credentials import own_credentials
from fognav.output import FailedError, WrongUseError

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_CONNECT_S: Final = 10.0
_POLL_S: Final = 0.05


@contextlib.asynccontextmanager
async def recording(
    path: Path,
    *,
    mqtt_url: str,
    zenoh: ZenohEdge,
    clock: Clock,
    numbers: Sequence[int] = (),
    credentials: Credentials = NOBODY,
) -> AsyncIterator[asyncio.Event]:
    """Record every channel while the context is open, which begins when the broker is connected.

    Yields what is set when nothing more can be written, which raises `FailedError` in the end. Raises `WrongUseError`
    if the file can't be made or the broker can't be reached.
    """
    failed, errors = asyncio.Event(), list[OSError]()

    def on_error(error: OSError) -> None:
        errors.append(error)
        failed.set()

    mqtt = _mqtt(mqtt_url, "fognav-record", clock, zenoh.site, credentials)
    try:
        recorder = Recorder(path, site=zenoh.site)
    except OSError as error:
        raise WrongUseError(f"{path} can't be written: {error.strerror}. Name another file") from error
    record_all(mqtt, zenoh, recorder, clock, on_error, numbers=numbers)
    task = asyncio.create_task(mqtt.run())
    try:
        await _wait_for_broker(mqtt, mqtt_url)
        yield failed
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        try:
            recorder.close()
        except OSError as error:  # no room for the index: what is there can be read
            on_error(error)
    if errors:
        raise FailedError(
            f"{path}: {errors[0].strerror}. What was recorded until then can be read: make room, and record the rest "
            "into another file"
        )


async def record(
    path: Path, *, mqtt_url: str, zenoh_endpoint: str, site: str, seconds: float, credentials: Credentials
) -> dict[str, object]:
    """Record for some seconds (0: until a signal); return a summary of the recording.

    Raises `WrongUseError` without broker or router; an existing file then stays unchanged. Raises `FailedError` as soon
    as nothing more can be written.
    """
    clock = SystemClock()
    opened = ZenohEdge.open(
        connect=[zenoh_endpoint], clock=clock, role="recorder", id="record", site=site, credentials=credentials
    )
    async with opened as zenoh:
        await _check_reachable(zenoh, zenoh_endpoint, mqtt_url, clock, credentials)
        stop = asyncio.Event()
        for number in _SIGNALS:
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        opened_file = recording(path, mqtt_url=mqtt_url, zenoh=zenoh, clock=clock, credentials=credentials)
        async with opened_file as failed, asyncio.TaskGroup() as tasks:
            ends = [tasks.create_task(each.wait()) for each in (stop, failed)]
            await asyncio.wait(ends, timeout=seconds or None, return_when=asyncio.FIRST_COMPLETED)
            for each in ends:
                each.cancel()
    return summary(path)


def summary(path: Path) -> dict[str, object]:
    """Return a recording's message counts, duration and bytes lost at its end; raises `WrongUseError`."""
    counts: dict[str, int] = {}
    first = last = 0
    try:
        for time_ns, channel, _, _ in read(path):
            counts[channel.name] = counts.get(channel.name, 0) + 1
            first = first or time_ns
            last = time_ns
        lost = bytes_lost(path)
    except OSError as error:
        raise WrongUseError(f"{path} can't be read: {error.strerror}. Name the file of a recording") from error
    except RecordError as error:
        raise WrongUseError(f"{error}. Name a file that fognav recorded") from error
    return {
        "file": str(path),
        "messages": counts,
        "seconds": round((last - first) / 1e9, 3),
        "bytes_lost": lost,
    }


async def play(path: Path, *, mqtt_url: str, zenoh_endpoint: str, site: str, speed: float) -> dict[str, object]:
    """Publish a recording's messages with their timing; return how many.

    Raises `WrongUseError` without broker or router, and for a file that is not a recording or empty, before anything is
    published.
    """
    contents = summary(path)
    if not contents["messages"]:
        raise WrongUseError(f"{path} contains no complete message. Record it again")
    clock, credentials = SystemClock(speed), own_credentials()
    mqtt = _mqtt(mqtt_url, "fognav-replay", clock, site, credentials)
    opened = ZenohEdge.open(
        connect=[zenoh_endpoint], clock=clock, role="console", id="replay", site=site, credentials=credentials
    )
    async with opened as zenoh:
        await _wait_for_router(zenoh, zenoh_endpoint)

        async def send(channel: Channel, ids: dict[str, str], message: Message | str) -> None:
            if channel.transport == "mqtt":
                await mqtt.publish(channel, message, wait=False, **ids)
            elif isinstance(message, Message):
                zenoh.publish(channel, message, **ids)

        task = asyncio.create_task(mqtt.run())
        try:
            await _wait_for_broker(mqtt, mqtt_url)
            return {"file": str(path), "sent": await replay(path, clock, send), "bytes_lost": contents["bytes_lost"]}
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


def _mqtt(url: str, client: str, clock: Clock, site: str, credentials: Credentials) -> MqttEdge:
    try:
        return MqttEdge(url, client, clock, site=site, credentials=credentials)
    except ValueError as error:
        raise WrongUseError(f"{url!r} is not a broker's URL ({error}). Correct --mqtt") from error


async def _check_reachable(
    zenoh: ZenohEdge, zenoh_endpoint: str, mqtt_url: str, clock: Clock, credentials: Credentials
) -> None:
    """Check that broker and router can be reached, before a file is overwritten; raises `WrongUseError`."""
    mqtt = _mqtt(mqtt_url, "fognav-check", clock, zenoh.site, credentials)
    connection = asyncio.create_task(mqtt.run())
    try:
        await _wait_for_broker(mqtt, mqtt_url)
    finally:
        connection.cancel()
        await asyncio.gather(connection, return_exceptions=True)
    await _wait_for_router(zenoh, zenoh_endpoint)


async def _wait_for_broker(mqtt: MqttEdge, url: str) -> None:
    try:
        async with asyncio.timeout(_CONNECT_S):
            await mqtt.wait_connected()
    except TimeoutError as error:
        raise WrongUseError(
            f"the broker {url} can't be reached: start the system, or name its broker with --mqtt"
        ) from error


async def _wait_for_router(zenoh: ZenohEdge, endpoint: str) -> None:
    deadline = time.monotonic() + _CONNECT_S
    while not zenoh.connected:
        if time.monotonic() > deadline:
            raise WrongUseError(
                f"the zenoh router {endpoint} can't be reached: start the system, or name its router with --zenoh, "
                "such as tcp/127.0.0.1:7447"
            )
        await asyncio.sleep(_POLL_S)
