"""A model of the store against a real Redis: versions, conditions, repeated requests, the audit trail, lost records.

`FOGNAV_STORE_EXAMPLES=1000` tries that many histories instead of eight.
"""

import asyncio
import itertools
import os

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test

from fog_contracts.messages import Message
from fog_runtime.stores.redis_connection import StoreLostError
from fog_runtime.stores.redis_store import Attempt, Audit, RedisStore, Table
from fog_supervisor.servers import Server, start_redis

pytestmark = pytest.mark.live
EXAMPLES = int(os.environ.get("FOGNAV_STORE_EXAMPLES", "8"))
THINGS = Table("things", "zone")
SITES = itertools.count()
ids = st.sampled_from(["a", "b"])
keys = st.none() | st.sampled_from(["k1", "k2", "k3"])
labels = st.sampled_from(["x", "y"])


class Thing(Message, frozen=True, kw_only=True):
    id: str
    label: str
    version: int = 1


@pytest.fixture(scope="module")
def redis(tmp_path_factory):
    with start_redis(tmp_path_factory.mktemp("redis")) as server:
        yield server


class StoreMachine(RuleBasedStateMachine):
    """Two processes of one service use a store; `things` is what it must contain."""

    server: Server

    def __init__(self) -> None:
        super().__init__()
        self.runner = asyncio.Runner()
        site = f"model{next(SITES)}"
        self.stores = [RedisStore(self.server.url, site) for _ in range(2)]
        self.things: dict[str, Thing] = {}
        self.floor = 0
        self.results: dict[str, Thing] = {}
        self.seen: dict[tuple[str, int], str] = {}
        self.changes = 0

    def teardown(self) -> None:
        for store in self.stores:
            self.runner.run(store._redis.aclose())
        self.runner.close()

    def _attempt(self, key: str | None) -> Attempt | None:
        return None if key is None else Attempt.of("anna", key, "PUT", "body")

    def _swap(self, store: RedisStore, name: str, thing: Thing | None, expected: str, key: str | None) -> str:
        audit = Audit(1.0, "anna", "put", self._attempt(key))
        return self.runner.run(store._swap(THINGS, name, thing, expected, audit))

    def _changed(self, name: str, thing: Thing, key: str | None) -> None:
        self.things[name] = thing
        self.changes += 1
        label = self.seen.setdefault((name, thing.version), thing.label)
        assert label == thing.label, "a version names two states"
        if key is not None:
            self.results[key] = thing

    @rule(process=st.integers(0, 1), name=ids, label=labels, key=keys, behind=st.integers(0, 2))
    def create(self, process: int, name: str, label: str, key: str | None, behind: int) -> None:
        thing = Thing(id=name, label=label, version=max(1, self.floor + 1 - behind))
        outcome = self._swap(self.stores[process], name, thing, "0", key)
        if key in self.results:
            same = self.results[key] == thing
            assert outcome == ("ok" if same else "exists")
        elif name in self.things:
            assert outcome == ("ok" if self.things[name] == thing else "exists")
        elif thing.version <= self.floor:
            assert outcome == "stale"
            assert self.stores[process]._floor("things") == self.floor
        else:
            assert outcome == "ok"
            self._changed(name, thing, key)

    @precondition(lambda self: self.things)
    @rule(process=st.integers(0, 1), name=ids, label=labels, key=keys, expected=st.integers(0, 2))
    def replace(self, process: int, name: str, label: str, key: str | None, expected: int) -> None:
        current = self.things.get(name)
        known = max(1, (current.version if current else 1) - expected)
        thing = Thing(id=name, label=label, version=known + 1)
        outcome = self._swap(self.stores[process], name, thing, str(known), key)
        if key in self.results:
            same = self.results[key] == thing
            assert outcome == ("ok" if same else "exists")
        elif current is None:
            assert outcome == "missing"
        elif current == thing:
            assert outcome == "ok"
        elif current.version != known:
            assert outcome == "stale"
        else:
            assert outcome == "ok"
            self._changed(name, thing, key)

    @rule(process=st.integers(0, 1), name=ids, other=st.integers(0, 1))
    def delete(self, process: int, name: str, other: int) -> None:
        current = self.things.get(name)
        version = (current.version if current else 1) + other
        outcome = self._swap(self.stores[process], name, None, str(version), None)
        if current is None:
            assert outcome == "missing"
        elif other:
            assert outcome == "stale"
        else:
            assert outcome == "ok"
            self.floor = max(self.floor, self.things.pop(name).version)
            self.changes += 1

    @precondition(lambda self: self.changes)
    @rule(process=st.integers(0, 1))
    def lose_everything_and_restore(self, process: int) -> None:
        store = self.stores[process]
        # Both processes know of everything before the loss, as after a start or a check.
        for each in self.stores:
            self.runner.run(each._load_floor("things"))
            self.runner.run(each.check())
        self.runner.run(store._redis.write(*(("DEL", store._key(key)) for key in ("things", "generation", "writes"))))
        for each in self.stores:
            with pytest.raises(StoreLostError):
                self._swap(each, "a", Thing(id="a", label="x", version=99), "0", None)
            with pytest.raises(StoreLostError):
                self.runner.run(each.check())
        self.runner.run(store._adopt({"things": self.things}, Audit(1.0, "ada", "restore")))

    @invariant()
    def both_processes_read_what_was_acknowledged(self) -> None:
        for store in self.stores:
            assert self.runner.run(store._readable_records("things", Thing)) == self.things
        entries = self.runner.run(self.stores[0].audit(kinds=["zone"], limit=1000)).entries
        assert len(entries) == self.changes


def test_store_behaves_as_its_model(redis: Server):
    StoreMachine.server = redis
    run_state_machine_as_test(
        StoreMachine,
        settings=settings(
            max_examples=EXAMPLES, stateful_step_count=20, deadline=None, suppress_health_check=list(HealthCheck)
        ),
    )
