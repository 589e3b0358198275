import asyncio
import json
import time

import msgspec
import pytest
from manual_clock import ManualClock
from mcap.reader import make_reader

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_runtime.clock import SystemClock
from fog_runtime.record import Recorder, RecordError, read, read_entries, record_all, replay
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor.servers import start_mosquitto, start_router


def reading(seq):
    return m.NodeReading(seq=seq, boot=1, uptime_ms=5, range_m=[1.0, None], status=["ok", "no_echo"], state="clear")


def delta(seq):
    return m.MapDelta(
        epoch=1,
        seq=seq,
        part=0,
        parts=1,
        layer="cost",
        x=0,
        y=0,
        w=3,
        h=1,
        packing="raw",
        cells=b"\x00\xfe\xff",
        hash=5,
    )


EVENTS = [
    (1_000_000_000, ch.NODE_READING, {"node": "n1"}, reading(1)),
    (1_500_000_000, ch.NODE_AVAILABILITY, {"node": "n1"}, "offline"),
    (2_500_000_000, ch.MAP_DELTA, {}, delta(1)),
    (2_500_000_000, ch.NODE_READING, {"node": "n2"}, reading(2)),
]


def record(path, events):
    with Recorder(path, site="lab") as recorder:
        for log_time, channel, ids, message in events:
            recorder.write(channel, ids, message, log_time)


def test_reading_a_recording_returns_the_same_messages_in_order(tmp_path):
    record(tmp_path / "a" / "r.mcap", EVENTS)
    assert list(read(tmp_path / "a" / "r.mcap")) == EVENTS


def test_mcap_readers_find_topics_schemas_and_json(tmp_path):
    record(tmp_path / "r.mcap", EVENTS)
    with (tmp_path / "r.mcap").open("rb") as file:
        found = list(make_reader(file).iter_messages())
    assert {info.topic for _, info, _ in found} == {
        "fog/v1/lab/nodes/n1/reading", "fog/v1/lab/nodes/n1/availability", "fog/lab/map/delta",
        "fog/v1/lab/nodes/n2/reading",
    }  # fmt: skip
    for schema, info, record_ in found:
        assert (schema.encoding, info.message_encoding) == ("jsonschema", "json")
        described = json.loads(schema.data)
        assert described["type"] == "object"
        assert set(json.loads(record_.data)) <= set(described["properties"])


@pytest.mark.parametrize("lost", [1, 8, 9, 100, 5_000, 20_000])
def test_complete_records_of_a_truncated_recording_are_read(tmp_path, lost):
    path = tmp_path / "r.mcap"
    record(path, [(n, ch.NODE_READING, {"node": "n1"}, reading(n)) for n in range(5000)])
    data = path.read_bytes()
    path.write_bytes(data[:-lost])
    got = [message.seq for _, _, _, message in read(path)]
    assert 100 < len(got) <= 5000
    assert got == list(range(len(got)))


@pytest.mark.parametrize("content", [b"", b"nothing of the kind, but long enough to look at"])
def test_file_that_is_not_a_recording_is_refused_by_name(tmp_path, content):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordError, match=r"x\.mcap"):
        list(read(path))


@pytest.mark.parametrize("share", range(1, 40))
def test_damaged_recording_gives_the_messages_before_the_damage_or_is_refused(tmp_path, share):
    path = tmp_path / "x.mcap"
    events = [(n, ch.NODE_READING, {"node": "n1"}, reading(n)) for n in range(1500)]
    record(path, events)
    data = bytearray(path.read_bytes())
    data[len(data) * share // 40] ^= 0x55
    path.write_bytes(data)
    got = []
    try:
        got.extend(read(path))
    except RecordError as error:
        assert "x.mcap" in str(error)  # noqa: PT017  # reading may also succeed: damage in the index loses no message
    assert got == events[: len(got)]


def test_zeros_between_records_are_reported_as_damage(tmp_path):
    path = tmp_path / "x.mcap"
    record(path, [(n, ch.NODE_READING, {"node": "n1"}, reading(n)) for n in range(1500)])
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    second = summary.chunk_indexes[1].chunk_start_offset
    data = bytearray(path.read_bytes())
    data[second : second + 64] = bytes(64)
    path.write_bytes(data)
    with pytest.raises(RecordError, match=rf"x\.mcap: is damaged before byte {second}"):
        list(read(path))


async def test_replay_keeps_the_recorded_intervals(tmp_path):
    record(tmp_path / "r.mcap", EVENTS)
    clock, sent = ManualClock(100.0), []

    async def send(channel, ids, message):
        sent.append((clock.now(), channel, ids, message))

    task = asyncio.create_task(replay(tmp_path / "r.mcap", clock, send))
    while not task.done():
        for _ in range(3):
            await asyncio.sleep(0)
        assert clock.now() < 110.0, f"the replay of 1.5 s has not ended after 10: {sent}"
        clock.advance(0.25)
    assert await task == 4
    assert [time_s for time_s, *_ in sent] == [100.0, 100.5, 101.5, 101.5]
    assert [tuple(rest) for _, *rest in sent] == [tuple(rest) for _, *rest in EVENTS]


@pytest.mark.live
@pytest.mark.parametrize("speed", [1.0, 100.0])
async def test_record_all_records_both_transports_at_any_clock_speed(tmp_path, speed):
    clock, started = SystemClock(speed), time.time()
    with start_mosquitto(tmp_path / "m") as broker, start_router(tmp_path / "z") as router:
        mqtt = MqttEdge(broker.url, "rec", clock, site="lab")
        async with ZenohEdge.open(connect=[router.endpoint], clock=clock, role="test", id="t", site="lab") as zenoh:
            with Recorder(tmp_path / "r.mcap") as recorder:
                record_all(mqtt, zenoh, recorder, clock, pytest.fail, numbers=[1])
                task = asyncio.create_task(mqtt.run())
                await asyncio.wait_for(mqtt.wait_connected(), 60)
                zenoh.publish(ch.MAP_DELTA, delta(1))
                await mqtt.publish(ch.NODE_READING, reading(1), node="n1")
                await mqtt.publish(ch.THESIS_AREA, "blocked", number="1")
                deadline = time.monotonic() + 60
                while len(recorder._counts) < 3:
                    assert time.monotonic() < deadline, recorder._counts
                    await asyncio.sleep(0.01)
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
    events = list(read(tmp_path / "r.mcap"))
    # A recording begins at the real time, however fast its clock runs.
    assert all(started <= log_ns * 1e-9 <= started + speed * (time.time() - started) for log_ns, *_ in events)
    got = {channel.name: (ids, message) for _, channel, ids, message in events}
    assert got == {
        "map_delta": ({}, delta(1)),
        "node_reading": ({"node": "n1"}, reading(1)),
        "thesis_area": ({"number": "1"}, "blocked"),
    }


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    number: int
    data: bytes


def test_entries_that_belong_to_no_channel_are_read_separately_from_messages(tmp_path):
    path = tmp_path / "both.mcap"
    heartbeat = m.MapHeartbeat(epoch=1, seq=2, hash=3, sent=(0, 4.0))
    with Recorder(path, site="lab") as recorder:
        recorder.write_entry("own/entry", Entry(number=1, data=b"\x00\xff"), 10)
        recorder.write(ch.MAP_HEARTBEAT, {}, heartbeat, 11)
        recorder.write_entry("own/entry", Entry(number=2, data=b""), 12)
    assert list(read(path)) == [(11, ch.MAP_HEARTBEAT, {}, heartbeat)]
    entries = [(log_ns, topic, msgspec.json.decode(data, type=Entry)) for log_ns, topic, data in read_entries(path)]
    assert entries == [
        (10, "own/entry", Entry(number=1, data=b"\x00\xff")),
        (12, "own/entry", Entry(number=2, data=b"")),
    ]
