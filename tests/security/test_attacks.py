"""Attacks of those who have no credential, on servers as `fognav` starts them: who has one is served all the same."""

import asyncio
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
import psutil
import pytest
from attacks import ATTACKS, LIMIT_S, Attack, running
from fronts import running_front
from locked_servers import LockedSite

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_runtime.access.server_certificate import ServerCertificate
from fog_runtime.clock import SystemClock
from fog_runtime.health import Health
from fog_runtime.http import Routes, Tokens, make_app
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fog_supervisor.servers import router_program
from fog_supervisor.supervisor import Supervisor
from fognav.programs import ProgramSet, SystemFolder

pytestmark = [pytest.mark.live, pytest.mark.timeout(300)]

CONNECT_S = 2.0
BACK_S = 5.0
MAP_S = 1.0
"""Older than this, a map makes a robot slow down."""
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


def small_app():
    made = make_app("Test", Health(), Tokens())
    routes = Routes(made, "test")
    routes.urgent("/robots/{robot}/stop")

    @routes.post("/robots/{robot}/stop")
    async def stop(robot: str) -> str:
        return robot

    return made


HALF_A_HEADER = b"GET /healthz HTTP/1.1\r\nHost: fog\r\nX-Name: "
ON_REST = ATTACKS | {
    "begin a request and stay": lambda port: Attack(port, HALF_A_HEADER, rate=40, held_s=600.0, encrypts=True),
    "send nonsense encrypted": lambda port: Attack(port, b"nonsense\r\n\r\n", rate=40, held_s=600.0, encrypts=True),
}


@pytest.mark.parametrize("name", ON_REST)
async def test_rest_stops_robots_while_strangers_fill_its_connections(site, tmp_path, capfd, name):
    folder = site.locks.folder("http")
    certificate = ServerCertificate(folder / "server.pem", folder / "server.key")
    with few_files():
        fronts = running_front(small_app, tmp_path, certificate=certificate)
        url = (await fronts.__aenter__()).replace("http:", "https:")
    trust = site.credentials("console").tls_context()
    try:

        async def stop(client: httpx.AsyncClient) -> float:
            begun = time.monotonic()
            assert (await client.post("/robots/r1/stop")).json() == "r1"
            return time.monotonic() - begun

        front = psutil.Process().children()[-1]
        async with httpx.AsyncClient(base_url=url, verify=trust, timeout=LIMIT_S) as client:
            async with running(ON_REST[name](client.base_url.port)):
                during = await stop(client)
            after = await stop(client)
        assert during < CONNECT_S
        assert after < BACK_S
        assert front.memory_info().rss < 2 * MEMORY_BYTES
        assert len(capfd.readouterr().err) < LOG_BYTES
    finally:
        await fronts.__aexit__(None, None, None)


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
