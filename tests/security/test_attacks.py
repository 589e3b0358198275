"""Attacks of those who have no credential, on servers as `fognav` starts them: who has one is served all the same."""

import asyncio
import contextlib
import resource
import ssl
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager

import psutil
import pytest
from locked_servers import LockedSite

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_runtime.clock import SystemClock
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fog_supervisor.servers import router_program
from fog_supervisor.supervisor import Supervisor
from fognav.programs import ProgramSet, SystemFolder

pytestmark = [pytest.mark.live, pytest.mark.timeout(300)]

LIMIT_S = 60.0
CONNECT_S = 2.0
BACK_S = 5.0
MAP_S = 1.0
"""Older than this, a map makes a robot slow down."""
FLOOD = 1100
MEMORY_BYTES = 150 * 1024 * 1024
LOG_BYTES = 20_000


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return LockedSite(tmp_path_factory.mktemp("attacked"), "lab", robots=["r1"], nodes=["n1"])


@contextmanager
def few_files(number: int = 1024) -> Iterator[None]:
    """Start servers with as many descriptors as on a usual system; attackers have enough."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (number, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


class Attack:
    """Opens connections from one address, `rate` a second, says something on each, and closes it after a while."""

    def __init__(self, port: int, said: bytes, *, rate: int, held_s: float, encrypts: bool = False) -> None:
        self._port = port
        self._said = said
        self.rate = rate
        self._held_s = held_s
        self._tls = net.unverified() if encrypts else None
        self.made = 0

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        begun = loop.time()
        async with asyncio.TaskGroup() as tasks:
            while True:
                while self.made < (loop.time() - begun) * self.rate:
                    self.made += 1
                    tasks.create_task(self._hold())
                await asyncio.sleep(0.01)

    async def _hold(self) -> None:
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(30.0):
                reader, writer = await asyncio.open_connection(net.LOOPBACK, self._port, ssl=self._tls)
            try:
                writer.write(self._said)
                async with asyncio.timeout(self._held_s):
                    await reader.read()
            finally:
                writer.transport.abort()


def client_hello() -> bytes:
    """What a TLS client says first."""
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = net.unverified().wrap_bio(incoming, outgoing, server_hostname="localhost")
    with contextlib.suppress(ssl.SSLWantReadError):
        client.do_handshake()
    return outgoing.read()


ATTACKS: dict[str, Callable[[int], Attack]] = {
    "say nothing and leave": lambda port: Attack(port, b"", rate=20, held_s=0.0),
    "say nothing and stay": lambda port: Attack(port, b"", rate=300, held_s=600.0),
    "begin to encrypt and leave": lambda port: Attack(port, client_hello(), rate=20, held_s=0.0),
    "begin to encrypt and stay": lambda port: Attack(port, client_hello(), rate=100, held_s=600.0),
    "encrypt and stay": lambda port: Attack(port, b"", rate=40, held_s=600.0, encrypts=True),
    "say nonsense": lambda port: Attack(port, b"GET / HTTP/1.1\r\n\r\n", rate=50, held_s=0.5),
}


@asynccontextmanager
async def running(attack: Attack) -> AsyncIterator[None]:
    """Run an attack, from its sixth second or 1,100th connection on: more than a process has descriptors."""
    task = asyncio.create_task(attack.run())
    try:
        async with asyncio.timeout(LIMIT_S):
            while attack.made < min(FLOOD, attack.rate * 6):  # noqa: ASYNC110  # the attack sets no event
                await asyncio.sleep(0.1)
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def opened(site: LockedSite, url: str, user: str, role: str):
    return ZenohEdge.open(
        connect=[url], clock=SystemClock(), role=role, id=user, site="lab", credentials=site.credentials(user)
    )


def heartbeat(seq: int) -> m.MapHeartbeat:
    return m.MapHeartbeat(epoch=1, seq=seq, hash=0, sent=(0, float(seq)))


@pytest.mark.parametrize("name", ATTACKS)
async def test_robot_goes_on_and_another_connects_while_strangers_fill_the_router(site, name):
    with few_files():
        server = site.router()
    ages: list[float] = []
    with server:
        async with (
            opened(site, server.url, "map-service", "map-service") as fog,
            opened(site, server.url, "r1", "robot-agent") as robot,
        ):
            heard = asyncio.Event()
            last = time.monotonic()

            def on_heartbeat(_: dict[str, str], __: m.MapHeartbeat) -> None:
                nonlocal last
                ages.append(time.monotonic() - last)
                last = time.monotonic()
                heard.set()

            robot.subscribe(ch.MAP_HEARTBEAT, m.MapHeartbeat, on_heartbeat)

            async def beat() -> None:
                seq = 0
                while True:
                    seq += 1
                    fog.publish(ch.MAP_HEARTBEAT, heartbeat(seq))
                    await asyncio.sleep(0.1)

            beating = asyncio.create_task(beat())
            async with asyncio.timeout(LIMIT_S):
                await heard.wait()
            ages.clear()
            async with running(ATTACKS[name](server.port)):
                during = await connects_after(site, server.url)
            after = await connects_after(site, server.url)
            assert max(ages) < MAP_S, max(ages)
            beating.cancel()
        assert during < CONNECT_S
        assert after < BACK_S
        assert psutil.Process(server.pid).memory_info().rss < MEMORY_BYTES
        assert server.log.stat().st_size < LOG_BYTES, server.log.read_text()[-2000:]


async def connects_after(site: LockedSite, url: str) -> float:
    """Return how long a client with a credential takes until it has a session."""
    begun = time.monotonic()
    async with asyncio.timeout(LIMIT_S):
        async with opened(site, url, "planner", "planner") as edge:
            while not edge.connected:  # noqa: ASYNC110  # the edge sets no event
                await asyncio.sleep(0.01)
            return time.monotonic() - begun


async def test_router_to_which_no_session_can_be_opened_ends_and_is_started_again(site, tmp_path):
    """As when something in it hangs: its process runs, and its port accepts connections, for nothing."""
    folder = SystemFolder(tmp_path)
    program = router_program(net.free_port(), locks=site.locks.folder("zenoh"))
    async with Supervisor(lambda _: None) as supervisor:
        ProgramSet(supervisor, folder, {}).add_server(program)
        supervisor.start(program.name)
        await supervisor.wait_ready([program.name], LIMIT_S)
        assert await connects_after(site, program.url) < LIMIT_S
        pid = supervisor.pid(program.name)
        used = psutil.Process(pid).num_fds()
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (used, used))
        async with asyncio.timeout(2 * LIMIT_S):
            while supervisor.pid(program.name) in (pid, None):  # noqa: ASYNC110  # the supervisor sets no event
                await asyncio.sleep(0.1)
        assert "RouterDeafError" in folder.log(program.name).read_text()
        assert await connects_after(site, program.url) < LIMIT_S
