"""The audit trail in a real Redis, read page by page."""

import itertools

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fog_runtime.stores.records import KINDS, PAGE_BYTES, read_page
from fog_runtime.stores.redis_connection import RedisConnection
from fog_supervisor.servers import start_redis

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def redis(tmp_path_factory):
    with start_redis(tmp_path_factory.mktemp("redis")) as server:
        yield server


numbers = itertools.count()


async def pages(url: str, entries: list[tuple[str, str, int]], kinds: tuple[str, ...], limit: int) -> list[list[str]]:
    """Store entries (kind, stream id, size) and return the names of those on each page."""
    connection, prefix = RedisConnection(url), f"trail-{next(numbers)}:"
    for name, (kind, stream_id, size) in enumerate(entries):
        value = msgspec.json.encode("x" * size)
        fields = ("at", "1.0", "who", "anna", "action", "put", "id", str(name), "before", "", "after", value)
        await connection.write(("XADD", f"{prefix}{kind}", stream_id, *fields))
    found, cursor = [], None
    while True:
        page = await read_page(connection, prefix, kinds=kinds, cursor=cursor, limit=limit)
        found.append([entry.id for entry in page.entries])
        if (cursor := page.next) is None:
            await connection.aclose()
            return found


async def test_page_of_large_entries_ends_early_and_the_next_ones_have_the_rest(redis):
    entries = [("zone", f"{number}-0", 40_000) for number in range(1, 101)]
    found = await pages(redis.url, entries, KINDS, 1000)
    assert [name for page in found for name in page] == [str(number) for number in range(99, -1, -1)]
    assert {len(page) for page in found[:-1]} == {-(-PAGE_BYTES // 40_000)}


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    gaps=st.lists(st.tuples(st.sampled_from(["area", "stop", "zone"]), st.integers(0, 2)), max_size=70),
    limit=st.integers(1, 40),
    kinds=st.sampled_from([KINDS, ("zone",), ("area", "stop")]),
)
async def test_pages_hold_every_entry_of_their_kinds_once_newest_first(redis, gaps, limit, kinds):
    entries, at = [], dict.fromkeys(KINDS, 0)
    for kind, gap in gaps:
        at[kind] += 1 + gap
        entries.append((kind, f"{at[kind]}-1", 3))
    found = await pages(redis.url, entries, kinds, limit)
    # Of entries at the same moment the later kind by name is the newer one.
    placed = sorted(((int(i.split("-")[0]), kind, str(n)) for n, (kind, i, _) in enumerate(entries)), reverse=True)
    assert [name for page in found for name in page] == [name for _, kind, name in placed if kind in kinds]
    assert all(len(page) == limit for page in found[:-1])
