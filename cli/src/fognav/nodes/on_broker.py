"""Sensor nodes on a broker: their readings as they come, and what they learn on command."""

from __future__ import annotations

import asyncio
import os
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Final

import aiomqtt

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError, decode, decode_text, encode, encode_text
from fog_contracts.messages import NodeCalibration, NodeReading
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.transports.mqtt_connection import Broker
from fognav.output import FailedError, WrongUseError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from fog_contracts.channels import Channel
    from fog_contracts.messages import NodeUpdate

CALIBRATION_S: Final = 180.0
"""A node with two sonars measures for some 40 s, one with eight for two minutes; without an answer after this it is not
there, or its firmware is too old."""


@asynccontextmanager
async def _connected(url: str, topics: dict[str, int], credentials: Credentials) -> AsyncIterator[aiomqtt.Client]:
    try:
        broker = Broker.of(url, credentials)
    except ValueError as error:
        raise WrongUseError(f"--broker {url}: {error}") from error
    try:
        async with broker.client(f"fognav-node-{os.getpid()}", None) as client:
            await client.subscribe(list(topics.items()))
            yield client
    except aiomqtt.MqttError as error:
        raise FailedError(
            f"the broker at {broker} can't be used: {error}. Check its address and your password"
        ) from error


async def readings(
    url: str, site: str, node: str, credentials: Credentials = NOBODY
) -> AsyncIterator[NodeReading | str]:
    """Yield what a node publishes, until cancelled: readings, and `online` or `offline`.

    Raises `FailedError` for a broker that can't be used, or when the connection ends.
    """
    reading, availability = (channel.key(site=site, node=node) for channel in (ch.NODE_READING, ch.NODE_AVAILABILITY))
    async with _connected(url, {reading: 0, availability: 1}, credentials) as client:
        async for message in client.messages:
            data = _bytes(message)
            try:
                if message.topic.value == reading:
                    yield decode(ch.NODE_READING, data, NodeReading)
                elif data:
                    yield decode_text(ch.NODE_AVAILABILITY, data)
            except ContractError as error:
                yield f"not understood: {error}"


async def learn(url: str, site: str, node: str, command: str, credentials: Credentials = NOBODY) -> NodeCalibration:
    """Let a node learn its limits (`CALIBRATE`) or its board's "no echo" (`LEARN_NO_ECHO`), and return what it learned.

    Raises `FailedError` with the node's own words if it refused, or if it does not answer within `CALIBRATION_S`.
    """
    keys = {channel: channel.key(site=site, node=node) for channel in (ch.NODE_CALIBRATION, ch.NODE_PROBLEM)}
    try:
        async with (
            asyncio.timeout(CALIBRATION_S),
            _connected(url, dict.fromkeys(keys.values(), 1), credentials) as client,
        ):
            await client.publish(
                ch.NODE_COMMAND.key(site=site, node=node),
                encode_text(ch.NODE_COMMAND, command),
                qos=ch.NODE_COMMAND.qos,
            )
            async for message in client.messages:
                if message.retain:
                    continue  # an earlier answer, which the broker kept
                found = _answer(keys, message)
                if isinstance(found, NodeCalibration):
                    return found
                if found:
                    raise FailedError(f"node {node} refused: {found}")
    except TimeoutError:
        raise FailedError(
            f"node {node} did not answer within {CALIBRATION_S:.0f} s: check that it is online (fognav node list)"
        ) from None
    raise FailedError(f"the broker closed the connection before node {node} answered: try again")


async def update(
    url: str, site: str, node: str, offer: NodeUpdate, credentials: Credentials = NOBODY, *, seconds: float
) -> NodeReading:
    """Offer a node an update, and return its first reading after the restart; the offer is withdrawn then.

    Raises `FailedError` with the node's own words if it refused or failed, or if it has not restarted after `seconds`.
    """
    reading, problem = (channel.key(site=site, node=node) for channel in (ch.NODE_READING, ch.NODE_PROBLEM))
    topic, channel = ch.NODE_UPDATE.key(site=site, node=node), ch.NODE_UPDATE
    before: int | None = None
    async with _connected(url, {reading: 0, problem: 1}, credentials) as client:
        try:
            async with asyncio.timeout(seconds):
                async for message in client.messages:
                    if message.topic.value == reading:
                        found = decode(ch.NODE_READING, _bytes(message), NodeReading)
                        if before is None:
                            await client.publish(topic, encode(channel, offer), qos=channel.qos, retain=True)
                        elif found.boot != before:
                            return found
                        before = found.boot
                    elif before is not None and not message.retain and (words := _bytes(message).decode()):
                        raise FailedError(f"node {node} was not updated: {words}")
        except TimeoutError:
            what = "is not there (fognav node list)" if before is None else "has not restarted"
            raise FailedError(f"node {node} {what}: waited {seconds:g} s") from None
        except ContractError as error:
            raise FailedError(f"what node {node} says was not understood: {error}") from error
        finally:
            if before is not None:
                await client.publish(topic, b"", qos=channel.qos, retain=True)
    raise FailedError(f"the broker closed the connection before node {node} was updated: try again")


def _answer(keys: dict[Channel, str], message: aiomqtt.Message) -> NodeCalibration | str:
    data = _bytes(message)
    if not data:
        return ""
    try:
        if message.topic.value == keys[ch.NODE_CALIBRATION]:
            return decode(ch.NODE_CALIBRATION, data, NodeCalibration)
        return decode_text(ch.NODE_PROBLEM, data)
    except ContractError as error:
        raise FailedError(f"the node's answer was not understood: {error}. Is its firmware of this version?") from error


def _bytes(message: aiomqtt.Message) -> bytes:
    return bytes(message.payload)
