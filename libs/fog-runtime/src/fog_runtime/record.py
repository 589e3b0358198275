"""Recording of all channels into MCAP files, which Foxglove can open, and reading or replaying them.

Messages are stored as JSON with their JSON schema, under their topic or key. A process may also record entries of its
own that belong to no channel (`Recorder.write_entry`, `read_entries`); `read` skips them.
"""

from __future__ import annotations

import os
import struct
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Self, cast

import msgspec
from mcap.exceptions import EndOfFile, InvalidMagic
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.stream_reader import MAGIC_SIZE
from mcap.writer import Writer

from fog_contracts.channels import CHANNELS, Channel
from fog_contracts.codec import json_schema
from fog_contracts.messages import Message
from fog_runtime import logs

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator, Sequence
    from pathlib import Path

    from fog_runtime.clock import Clock
    from fog_runtime.transports.mqtt_edge import MqttEdge
    from fog_runtime.transports.zenoh_edge import ZenohEdge

_CHUNK: Final = 64 * 1024
"""Bytes that a crash may lose."""

_RECORD_HEADER: Final = 9
_NO_OPCODE: Final = 0
_ENTRY: Final = "entry"
"""Metadata that marks an entry that belongs to no channel."""

_log = logs.get("record")


class RecordError(ValueError):
    """A file is not a recording, or is damaged; the message names it and what is wrong."""


class _Text(Message, frozen=True, kw_only=True):
    """The stored form of a plain text message."""

    text: str


def _finish(writer: Any) -> None:  # noqa: ANN401  # mcap leaves the method untyped
    """Write the index and the end of the file."""
    writer.finish()


class Recorder:
    """Writes messages to an MCAP file; close it, or use it as a context manager. For one thread."""

    def __init__(self, path: Path, *, site: str = "") -> None:
        """Create the file at `path`, replacing an old one; `site` is filled into keys that contain one."""
        self._site = site
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=_CHUNK)
        self._writer.start(profile="fognav", library="fog-runtime")
        self._schemas: dict[type[msgspec.Struct], int] = {}
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}

    def write(self, channel: Channel, ids: dict[str, str], message: Message | str, log_time_ns: int) -> None:
        """Write one message; raises `ValueError` when an id is missing."""
        if "site" in channel.fields and "site" not in ids:
            ids = {**ids, "site": self._site}
        key = channel.key(**ids)
        content = _Text(text=message) if isinstance(message, str) else message
        self._add(key, content, {"channel": channel.name}, log_time_ns)

    def write_entry(self, topic: str, entry: msgspec.Struct, log_time_ns: int) -> None:
        """Write an entry that belongs to no channel, under a topic of its own that holds one type of entry."""
        self._add(topic, entry, {_ENTRY: topic}, log_time_ns)

    def _add(self, topic: str, content: msgspec.Struct, metadata: dict[str, str], log_time_ns: int) -> None:
        number = self._channels.get(topic)
        if number is None:
            number = self._channels[topic] = self._register(topic, type(content), metadata)
        self._counts[topic] = self._counts.get(topic, 0) + 1
        self._writer.add_message(
            channel_id=number,
            log_time=log_time_ns,
            publish_time=log_time_ns,
            sequence=self._counts[topic],
            data=msgspec.json.encode(content),
        )

    def _register(self, topic: str, kind: type[msgspec.Struct], metadata: dict[str, str]) -> int:
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_schema(
                name=f"fognav.{kind.__name__.lstrip('_')}", encoding="jsonschema", data=json_schema(kind)
            )
        return int(
            self._writer.register_channel(
                topic=topic, message_encoding="json", schema_id=self._schemas[kind], metadata=metadata
            )
        )

    def secure(self) -> None:
        """Let the disk have all complete chunks: a loss of power takes only what came after. Raises `OSError`."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Write the index and close the file, even when the disk has no room for the index (`OSError`)."""
        try:
            _finish(self._writer)
        finally:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read(path: Path) -> Iterator[tuple[int, Channel, dict[str, str], Message | str]]:
    """Yield (time in ns, channel, ids without the site, message) in the order of recording.

    Of a file that a crash truncated, all complete records are read. Raises `RecordError` for a file that is not a
    recording, or on reaching damaged bytes.
    """
    for info, record in _records(path):
        if _ENTRY in info.metadata:
            continue
        channel = CHANNELS.get(info.metadata.get("channel", ""))
        ids = channel.match(info.topic) if channel else None
        if channel is None or ids is None:
            raise RecordError(f"{path}: {info.topic!r} belongs to no channel of this version")
        ids.pop("site", None)
        yield record.log_time, channel, ids, _decode(path, channel, record.data)


def read_entries(path: Path) -> Iterator[tuple[int, str, bytes]]:
    """Yield (time in ns, topic, JSON) of the entries that belong to no channel; errors as for `read`."""
    for info, record in _records(path):
        if _ENTRY in info.metadata:
            yield record.log_time, info.topic, record.data


def _records(path: Path) -> Iterator[tuple[Any, Any]]:
    """Yield MCAP channel and message of each complete record; raises `RecordError` as `read` does."""
    size = path.stat().st_size
    if size < MAGIC_SIZE:
        raise RecordError(f"{path}: is not an MCAP file ({size} bytes)")
    with path.open("rb") as file:
        complete = _complete_size(path, file)
        if complete < size:
            _log.warning("recording_truncated", path=str(path), bytes_lost=size - complete)
        reader = NonSeekingReader(cast("BinaryIO", _FilePrefix(file, complete)), validate_crcs=True)
        yield from _messages(path, reader)


def bytes_lost(path: Path) -> int:
    """Return how many bytes at the end of a truncated recording belong to no complete record; 0 if it is complete.

    Raises `RecordError` for damage before that.
    """
    with path.open("rb") as file:
        return max(0, path.stat().st_size - _complete_size(path, file))


def _messages(path: Path, reader: NonSeekingReader) -> Iterator[tuple[Any, Any]]:
    """Yield MCAP channel and message of each complete record; raises `RecordError` for damage."""
    try:
        # Not by the index: a truncated file has none.
        for _, info, record in reader.iter_messages(log_time_order=False):
            yield info, record
    except EndOfFile:
        return  # truncated between two records: all complete ones were read
    except InvalidMagic as error:
        raise RecordError(f"{path}: is not an MCAP file") from error
    except Exception as error:  # the parser raises errors of many kinds for damage
        raise RecordError(f"{path}: is damaged, or not an MCAP file ({error!r})") from error


def _complete_size(path: Path, file: BinaryIO) -> int:
    """Return where the last complete record ends; a record is an opcode, a length of 8 bytes and its content.

    Raises `RecordError` where no record can begin.
    """
    size = file.seek(0, os.SEEK_END)
    end = MAGIC_SIZE
    while end + _RECORD_HEADER <= size:
        file.seek(end)
        opcode, length = struct.unpack("<BQ", file.read(_RECORD_HEADER))
        if opcode == _NO_OPCODE and end > MAGIC_SIZE:
            raise RecordError(f"{path}: is damaged before byte {end}: no record begins there")
        footer = opcode == Opcode.FOOTER
        after = end + _RECORD_HEADER + length + (MAGIC_SIZE if footer else 0)  # the closing magic belongs to the footer
        if after > size:
            break
        end = after
        if footer:
            break
    file.seek(0)
    return end


class _FilePrefix:
    """The first `size` bytes of a file."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file = file
        self._remaining = size

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(self._remaining if size < 0 else min(size, self._remaining))
        self._remaining -= len(data)
        return data


def _decode(path: Path, channel: Channel, data: bytes) -> Message | str:
    try:
        if channel.message is None:
            return msgspec.json.decode(data, type=_Text).text
        return msgspec.json.decode(data, type=channel.message)
    except msgspec.DecodeError as error:
        raise RecordError(f"{path}: a message of {channel.name} violates its contract: {error}") from error


def record_all(  # what is recorded, where, and by which clock
    mqtt: MqttEdge,
    zenoh: ZenohEdge,
    recorder: Recorder,
    clock: Clock,
    on_error: Callable[[OSError], object],
    *,
    numbers: Sequence[str | int] = (),
) -> None:
    """Record every published channel of both transports; call before `mqtt.run()`.

    The first error of the file is given to `on_error`, and ends the recording: what came after a gap would pass for
    all there was, and after a part of a chunk be no record at all.

    The log's times begin at the real time and continue in seconds of `clock`: a fast clock's own stamps lie centuries
    ahead, and soon beyond the range of MCAP's times. `numbers` lists the areas of the thesis's topics.
    """
    begin = clock.stamp()
    real_begin = begin / clock.speed
    ended = False

    def writer(channel: Channel) -> Callable[[dict[str, str], Any], None]:
        def write(ids: dict[str, str], message: Message | str) -> None:
            nonlocal ended
            if ended:
                return
            all_ids = {**ids, "site": zenoh.site} if "site" in channel.fields else ids
            try:
                recorder.write(channel, all_ids, message, int((real_begin + clock.stamp() - begin) * 1e9))
            except OSError as error:
                ended = True
                on_error(error)

        return write

    for channel in CHANNELS.values():
        if channel.transport == "mqtt" and channel.message is None:
            mqtt.on(channel, writer(channel), numbers=numbers)
        elif channel.transport == "mqtt" and channel.message is not None:
            mqtt.on(channel, writer(channel), channel.message)
        elif channel.kind == "pub" and channel.message is not None:
            zenoh.subscribe(channel, channel.message, writer(channel))


async def replay(
    path: Path, clock: Clock, send: Callable[[Channel, dict[str, str], Message | str], Awaitable[object]]
) -> int:
    """Pass every recorded message to `send` at its time relative to the first, by `clock`; return their number."""
    count = 0
    begin_ns = 0
    begin = clock.now()
    for log_time, channel, ids, message in read(path):
        if count == 0:
            begin_ns = log_time
        wait = begin + (log_time - begin_ns) / 1e9 - clock.now()
        if wait > 0.0:
            await clock.sleep(wait)
        await send(channel, ids, message)
        count += 1
    return count
