"""A store on a replicated Redis behind Sentinels: no acknowledged write is lost when primaries die.

`FOGNAV_KILLS=200` kills that many primaries instead of one; `FOGNAV_WRITES=50000` writes so often meanwhile.
"""

import asyncio
import contextlib
import dataclasses
import os
import random
import signal
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest
from redis.asyncio import Redis
from redis.exceptions import RedisError

from fog_contracts.messages import Message
from fog_runtime.credentials import Credentials
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.stores.redis_connection import RedisAddress, RedisConnection, StoreError, parse_address
from fog_runtime.stores.redis_store import Audit, RedisStore, Table
from fog_supervisor import configurations
from fog_supervisor.net import LOOPBACK, free_port
from fog_supervisor.servers import Server, ServerProgram, find_program

pytestmark = pytest.mark.live
KILLS = int(os.environ.get("FOGNAV_KILLS", "1"))
WRITES = int(os.environ.get("FOGNAV_WRITES", "50"))
THINGS = Table("things", "zone")
AUDIT = Audit(1.0, "anna", "create")


class Thing(Message, frozen=True, kw_only=True):
    version: int = 1


def program(name: str, folder: Path, port: int, text: str, *arguments: str) -> ServerProgram:
    """Return a Redis server or Sentinel with this configuration."""
    folder.mkdir()
    file = folder / "redis.conf"
    file.write_text(text)
    command = (str(find_program("redis-server")), str(file), *arguments)
    return ServerProgram(
        name=name, port=port, url=f"{LOOPBACK}:{port}", command=command, probe=b"PING\r\n", reply=b"+PONG"
    )


class Cluster:
    """Three Redis servers, of which one is the primary, and three Sentinels."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        ports: list[int] = []
        for _ in range(6):
            ports.append(free_port(set(ports)))
        primary, *others = ports[:3]
        self.servers: dict[int, Server] = {}
        for port in ports[:3]:
            home = folder / f"redis-{port}"
            text = configurations.redis(LOOPBACK, str(home), port=port) + configurations.replicated()
            if port in others:
                text += f"replicaof {LOOPBACK} {primary}\n"
            self.servers[port] = stack.enter_context(Server(program("redis", home, port, text), home))
        for port in ports[3:]:
            home = folder / f"sentinel-{port}"
            text = configurations.sentinel(f"{LOOPBACK} {primary}", str(home), bind=LOOPBACK, port=port)
            stack.enter_context(Server(program("sentinel", home, port, text, "--sentinel"), home))
        sentinels = ",".join(f"{LOOPBACK}:{port}" for port in ports[3:])
        self.url = f"redis+sentinel://{sentinels}/fognav/0?wait=1"
        self.sentinel = f"redis://{LOOPBACK}:{ports[3]}"

    async def primary(self) -> int:
        """Return the port of the primary, once two replicas follow it and the Sentinels know one another."""
        async with asyncio.timeout(60):
            while True:
                with contextlib.suppress(OSError, RedisError):
                    async with Redis.from_url(self.sentinel, socket_timeout=1.0) as sentinel:
                        state = await sentinel.sentinel_master("fognav")
                    async with Redis(host=LOOPBACK, port=state["port"], socket_timeout=1.0) as primary:
                        replication = await primary.info("replication")
                    states = [replication["role"], *(replication.get(f"slave{n}", {}).get("state") for n in (0, 1))]
                    if state["num-other-sentinels"] == 2 and states == ["master", "online", "online"]:
                        return int(state["port"])
                await asyncio.sleep(0.1)

    async def names(self, port: int) -> bool:
        """Whether the Sentinels name this server as the primary."""
        async with Redis.from_url(self.sentinel, socket_timeout=1.0) as sentinel:
            return bool((await sentinel.sentinel_master("fognav"))["port"] == port)


@pytest.fixture
def cluster(tmp_path: Path):
    with contextlib.ExitStack() as stack:
        yield Cluster(tmp_path, stack)


@pytest.mark.timeout(180 + 60 * KILLS + WRITES // 20)
async def test_no_acknowledged_write_is_lost_when_primaries_are_killed_under_load(cluster: Cluster):
    chance = random.Random(1)
    acknowledged: set[str] = set()
    refused: set[str] = set()
    stopped = asyncio.Event()
    await cluster.primary()
    async with RedisStore(cluster.url, "test") as store:

        async def write(writer: int) -> None:
            for number in count():
                if stopped.is_set():
                    return
                name = f"{writer}-{number}"
                try:
                    await store._swap(THINGS, name, Thing(), "0", AUDIT)
                    acknowledged.add(name)
                except StoreError as error:
                    refused.add(str(error))
                    await asyncio.sleep(0.05)

        writers = [asyncio.create_task(write(writer)) for writer in range(4)]
        for _ in range(KILLS):
            before = len(acknowledged)
            port = await cluster.primary()
            await asyncio.sleep(chance.uniform(0.0, 0.3))
            cluster.servers[port].kill()
            async with asyncio.timeout(60 + WRITES // 20):
                while len(acknowledged) < before + max(50, WRITES // KILLS) or await cluster.names(port):  # noqa: ASYNC110  # other processes
                    await asyncio.sleep(0.05)
            await asyncio.to_thread(cluster.servers[port].start)
        stopped.set()
        await asyncio.gather(*writers)
    async with RedisStore(cluster.url, "test", timeout_s=60.0) as store:  # reading so many takes long
        stored = set(await store._readable_records("things", Thing))
    lost = acknowledged - stored
    sys.stdout.write(f"{KILLS} kills: {len(acknowledged)} acknowledged, {len(lost)} lost\n")
    assert lost == set(), f"{len(lost)} of {len(acknowledged)} after {KILLS} kills"
    assert refused, "writes during a failover are refused"


async def test_write_without_enough_replicas_is_refused_and_said(cluster: Cluster):
    primary = await cluster.primary()
    async with RedisStore(cluster.url, "test") as store, Redis(host=LOOPBACK, port=primary) as raw:
        assert await store._swap(THINGS, "a", Thing(), "0", AUDIT) == "ok"
        await raw.config_set("min-replicas-to-write", 0)
        for port in cluster.servers:
            if port != primary:
                cluster.servers[port].kill()
        with pytest.raises(StoreError, match="0 of 1 replicas have the write"):
            await store._swap(THINGS, "b", Thing(), "0", AUDIT)
        with pytest.raises(StoreError, match="0 of 1 replicas"):
            await store.check()
        await raw.config_set("min-replicas-to-write", 1)
        with pytest.raises(StoreError, match="too few replicas"):
            await store.check()


def test_addresses():
    one = RedisAddress([("redis", 6379)], None, None, 0, "", 0, tls=False)
    assert parse_address("redis://redis") == one
    assert parse_address("redis://redis:6380/2?wait=1") == one._replace(hosts=[("redis", 6380)], db=2, replicas=1)
    secret = one._replace(hosts=[("h", 1)], username="me", password="p@ss", tls=True)
    assert parse_address("rediss://me:p%40ss@h:1/0") == secret
    several = RedisAddress([("a", 1), ("b", 26379)], None, None, 3, "fognav", 2, tls=False)
    assert parse_address("redis+sentinel://a:1,b/fognav/3?wait=2") == several
    for url in (
        "redis://", "redis://a,b/0", "redis://a/x", "redis://a/0/1", "redis://a?wait=x", "redis://a?db=1", "http://a",
        "redis+sentinel://a", "redis+sentinel:///fognav", "redis://a:99999",
    ):  # fmt: skip
        with pytest.raises(ValueError, match="must look like redis://host:6379/0"):
            parse_address(url)


@pytest.fixture
def secured_cluster(tmp_path):
    """Three locked Redis servers and a Sentinel: the address, whom services are there, and the primary."""
    security = SiteSecurity(tmp_path / "locks", "lab")
    security.make([LOOPBACK, "localhost"], copies=True)
    own, peer = (Credentials.read(security.credentials(user)) for user in ("map-service", "peer"))
    folder = security.folder("redis")
    (folder / "authority.pem").write_text(security.authority.trusted)
    known = configurations.Peer(name=LOOPBACK, user=peer.user, password=peer.passwords["redis"], security=str(folder))
    ports: list[int] = []
    with contextlib.ExitStack() as stack:

        def start(text_in: Callable[[str, int], str], reply: bytes, *arguments: str) -> Server:
            ports.append(free_port(set(ports)))
            home = tmp_path / f"server-{ports[-1]}"
            plain = program("redis", home, ports[-1], text_in(str(home), ports[-1]), *arguments)
            return stack.enter_context(Server(dataclasses.replace(plain, encrypted=True, reply=reply), home))

        def redis(home: str, port: int) -> str:
            text = configurations.redis(LOOPBACK, home, port=port, security=str(folder))
            follows = f"replicaof {LOOPBACK} {ports[0]}\n" if port != ports[0] else ""
            return text + configurations.replicated(known) + follows

        def sentinel(home: str, port: int) -> str:
            return configurations.sentinel(f"{LOOPBACK} {ports[0]}", home, known, port=port, quorum=1)

        primary = start(redis, b"-NOAUTH")
        for _ in range(2):
            start(redis, b"-NOAUTH")
        start(sentinel, b"+PONG", "--sentinel")
        yield f"{LOOPBACK}:{ports[-1]}/fognav/0", own, primary


async def store_once(url, credentials):
    connection = RedisConnection(url, timeout_s=5.0, credentials=credentials)
    try:
        async with asyncio.timeout(60):
            while True:
                try:
                    return await connection.write(("HSET", "fog:lab:zones", "z1", "{}"))
                except StoreError:  # no primary known yet, or no replica
                    await asyncio.sleep(0.2)
    finally:
        await connection.aclose()


async def test_locked_replica_takes_over_from_a_primary_that_dies(secured_cluster):
    address, own, primary = secured_cluster
    url = f"rediss+sentinel://{address}?wait=1"
    assert await store_once(url, own) == [1]
    primary.kill()
    assert await store_once(url, own) == [0], "the other one has it"


async def test_write_after_a_primary_fell_silent_goes_to_the_next_one_at_once(secured_cluster):
    address, own, primary = secured_cluster
    url = f"rediss+sentinel://{address}?wait=1"
    await store_once(url, own)
    connection = RedisConnection(url, credentials=own)
    await asyncio.gather(*(connection.read("HGET", "fog:lab:zones", "z1") for _ in range(2)))  # two are connected
    os.kill(primary.pid, signal.SIGSTOP)
    await store_once(url, own)
    assert await connection.write(("HSET", "fog:lab:zones", "z1", "{}")) == [0]
    await connection.aclose()


async def test_sentinels_of_another_authority_are_not_believed(secured_cluster, tmp_path):
    address, own, _ = secured_cluster
    stranger = SiteSecurity(tmp_path / "stranger", "lab")
    stranger.make([LOOPBACK])
    other = Credentials(own.user, passwords=own.passwords, authority=stranger.authority.trusted)
    connection = RedisConnection(f"rediss+sentinel://{address}", timeout_s=5.0, credentials=other)
    with pytest.raises(StoreError, match="no Sentinel knows"):
        await connection.write(("HSET", "fog:lab:zones", "z1", "{}"))
    await connection.aclose()
