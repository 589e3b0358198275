"""A fog for each test: its site and the processes under test, beside broker, Redis and router on loopback ports.

The servers of a test go on to the next one of this pytest process, emptied, unless it left other settings in Redis.
"""

import asyncio
import hashlib
import os
import secrets
import subprocess
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, contextmanager, suppress
from pathlib import Path

import httpx
import numpy as np
import paho.mqtt.client as paho
import programs
import pytest
import redis
from lateness import Lateness
from redis.asyncio import Redis

from fog_contracts.grid import GridGeometry, StaticMap
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.maps import save_map
from fog_runtime.credentials import Credentials
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor.servers import Server, start_mosquitto, start_redis, start_router

SITE = """
id = "test"
map = "map.yaml"

[[areas]]
id = "hall"
label = "the hall"
polygon = [[3.0, 2.0], [4.0, 2.0], [4.0, 4.0], [3.0, 4.0]]
number = 7

[[nodes]]
id = "n1"
area = "hall"
x = 3.5
y = 4.5
theta = -1.5707963
sonars = [{ range_limit = 1.5, no_echo_is_clear = true }, { angle = 0.2, range_limit = 1.5, no_echo_is_clear = true }]
"""
OPERATOR_TOKEN = "operator-token"
VIEWER_TOKEN = "viewer-token"
ADMIN_TOKEN = "admin-token"
GUEST_TOKEN = "for visitors"
TOKENS = (
    ("anna", "operator", OPERATOR_TOKEN), ("vera", "viewer", VIEWER_TOKEN), ("ada", "admin", ADMIN_TOKEN),
    ("gil", "guest", GUEST_TOKEN),
)  # fmt: skip
DEADLINE_S = 60.0
"""For any wait, which ends with what it waits for: long, because a busy machine may be ten times slower."""


class Servers:
    """Broker, Redis and router of the site, and the files by which they admit its users (if `secured`)."""

    def __init__(self, folder: Path, *, secured: bool = True) -> None:
        self.security = security = SiteSecurity(folder / "locks", "test", unrestricted=["test"]) if secured else None
        if security is not None:
            security.make(["127.0.0.1", "localhost"], nodes=["n1", "cleaning"])
        self.mosquitto: Server = start_mosquitto(
            folder / "mosquitto", security=security and security.folder("mosquitto")
        )
        self.redis: Server = start_redis(folder / "redis", security=security and security.folder("redis"))
        self.router: Server = start_router(folder / "router", security=security and security.folder("zenoh"))
        self._began_with = self._settings()

    def all(self) -> tuple[Server, ...]:
        return self.mosquitto, self.redis, self.router

    def redis_options(self) -> dict[str, object]:
        """Return how a client of Redis that may do everything connects."""
        if self.security is None:
            return {"port": self.redis.port}
        own = Credentials.read(self.security.credentials("administrator"))
        return {
            "port": self.redis.port, "ssl": True, "ssl_ca_data": own.authority, "username": own.user,
            "password": own.passwords["redis"],
        }  # fmt: skip

    def _settings(self) -> object:
        with redis.Redis(**self.redis_options()) as client:
            return client.config_get("*")

    def empty(self) -> bool:
        """Remove everything that is stored; return whether they are as good as new."""
        for server in self.all():
            server.start()  # unless it runs
        if self._settings() != self._began_with:
            return False
        with redis.Redis(**self.redis_options()) as client:
            client.flushall()
        self._remove_retained()
        return True

    def _remove_retained(self) -> None:
        """Delete all messages that the broker retains, and wait until it has done so."""
        end = f"end-of-test/{secrets.token_hex(8)}"
        retained: list[str] = []
        client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        if self.security is not None:
            own = Credentials.read(self.security.credentials("test"))
            client.tls_set_context(own.tls_context())
            client.username_pw_set(own.user, own.passwords["mqtt"])
        ended = threading.Semaphore(0)

        def on_message(_client: paho.Client, _data: object, message: paho.MQTTMessage) -> None:
            if message.topic == end:
                ended.release()
            elif message.retain:
                retained.append(message.topic)

        client.on_message = on_message
        client.on_subscribe = lambda *_: ended.release()
        client.connect("127.0.0.1", self.mosquitto.port)
        client.loop_start()
        try:
            client.subscribe("#", qos=1)
            assert ended.acquire(timeout=DEADLINE_S), "the broker does not answer"
            # A broker sends what it retains before what comes after the subscription.
            client.publish(end, qos=1)
            assert ended.acquire(timeout=DEADLINE_S), "the broker sends nothing"
            for topic in retained:
                client.publish(topic, b"", retain=True)
            # Acknowledged after all that was sent before it.
            client.publish(end, qos=1).wait_for_publish(DEADLINE_S)
        finally:
            client.disconnect()
            client.loop_stop()

    def close(self) -> None:
        for server in self.all():
            server.stop()


class ServersPool:
    """Lends servers to one test at a time; those that come back as good as new are lent again."""

    def __init__(self, new_folder: Callable[[], Path]) -> None:
        self._new_folder = new_folder
        self._idle: list[Servers] = []

    @contextmanager
    def lend(self) -> Iterator[Servers]:
        """Lend emptied servers, or new ones if none are idle."""
        lent = None
        while lent is None and self._idle:
            if not (lent := self._idle.pop()).empty():
                lent.close()
                lent = None
        lent = lent or Servers(self._new_folder())
        try:
            yield lent
        finally:
            self._idle.append(lent)

    def close(self) -> None:
        while self._idle:
            self._idle.pop().close()


class Fog:
    """A site with servers, and processes that can be started and killed."""

    def __init__(self, folder: Path, servers: Servers) -> None:
        self.folder = folder
        self.servers = servers
        self.security = servers.security
        self.mosquitto, self.redis, self.router = servers.all()
        self.site = folder / "site"
        self.site.mkdir()
        (self.site / "site.toml").write_text(SITE)
        cells = np.zeros((120, 160), dtype=np.uint8)
        cells[[0, -1], :] = 254
        cells[:, [0, -1]] = 254
        save_map(self.site / "map", StaticMap(GridGeometry(160, 120, 0.05, 0.0, 0.0), cells))
        tokens = folder / "tokens.toml"
        lines = []
        for name, role, token in TOKENS:
            digest = hashlib.sha256(token.encode()).hexdigest()
            lines += ["[[tokens]]", f'name = "{name}"', f'role = "{role}"', f'sha256 = "{digest}"']
        tokens.write_text("\n".join(lines))
        session_key = folder / "session.key"
        session_key.write_text("ab" * 32)
        self.environment = {
            **os.environ,
            "FOGNAV_SITE_DIR": str(self.site),
            "FOGNAV_DATA_DIR": str(folder / "data"),
            "FOGNAV_MQTT_URL": self.mosquitto.url,
            "FOGNAV_REDIS_URL": self.redis.url,
            "FOGNAV_ZENOH_CONNECT": self.router.endpoint,
            "FOGNAV_TOKENS_FILE": str(tokens),
            "FOGNAV_SESSION_KEY_FILE": str(session_key),
            # Short, because many tests start no aggregator.
            "FOGNAV_HAZARDS_WAIT_S": "0.3",
        }
        self.processes: dict[str, programs.Program] = {}
        self._killed: set[str] = set()
        """Processes that were killed while no other copy ran."""

    def start(self, module: str, name: str = "", **environment: str) -> None:
        """Start a program, as `python -m module` would; may be called again after a kill.

        Further copies of it need a `name`; `environment` overrides what all processes get.
        """
        name = name or module
        port_file = self.folder / f"{name}.port"
        port_file.unlink(missing_ok=True)
        own = self.credentials_file(module.replace("_", "-"))
        environment = {
            **self.environment,
            "FOGNAV_PORT_FILE": str(port_file),
            **({} if own is None else {"FOGNAV_CREDENTIALS_FILE": str(own)}),
            **environment,
        }
        self.processes[name] = programs.start(module, environment, self.folder / f"{name}.log")

    def credentials_file(self, user: str) -> Path | None:
        """Return the file of a user's credentials; None behind open doors."""
        return None if self.security is None else self.security.credentials(user)

    @property
    def test_credentials(self) -> Credentials:
        """Those of a user who may do everything on broker and router."""
        return Credentials.read(self.credentials_file("test"))

    def raw_redis(self) -> Redis:
        """Return a client of Redis that may do everything."""
        return Redis(**self.servers.redis_options())

    def kill(self, module: str) -> None:
        """Kill a process, as a crash would."""
        process = self.processes.pop(module)
        process.kill()
        process.wait()
        if not any(name.partition("-")[0] == module for name in self.processes):
            self._killed.add(module)

    def lateness(self) -> Lateness:
        """Return what tells how late a busy machine makes the processes from now on, this one among them."""

        def pids() -> list[int]:
            running = [server.pid for server in self.servers.all() if server.running()]
            return [os.getpid(), *running, *(process.pid for process in self.processes.values())]

        return Lateness(pids)

    def log(self, module: str) -> str:
        """Return everything that a process printed."""
        return (self.folder / f"{module}.log").read_text()

    async def url(self, module: str) -> str:
        """Return the URL of a process's REST API once it listens."""
        port_file = self.folder / f"{module}.port"

        def listens() -> bool:
            assert self.processes[module].poll() is None, f"{module} has ended:\n{self.log(module)}"
            return port_file.exists()

        await until(listens, f"{module} listens")
        return f"http://127.0.0.1:{port_file.read_text().strip()}"

    async def ready(self, module: str) -> str:
        """Return the URL of a process's REST API once it is ready."""
        url = await self.url(module)
        async with httpx.AsyncClient(timeout=DEADLINE_S) as client:
            deadline = time.monotonic() + DEADLINE_S
            while (answer := await client.get(f"{url}/readyz")).status_code != 200:
                assert time.monotonic() < deadline, (answer.text, self.log(module))
                await asyncio.sleep(0.05)
            # One that was started again stands by, and changes nothing, until the lease of the killed one has ended.
            while module in self._killed and "\nfognav_leader 0.0" in (await client.get(f"{url}/metrics")).text:
                assert time.monotonic() < deadline, self.log(module)
                await asyncio.sleep(0.05)
        self._killed.discard(module)
        return url

    @asynccontextmanager
    async def edges(self) -> AsyncIterator[tuple[MqttEdge, ZenohEdge, Callable[[], None]]]:
        """Yield an MQTT edge, a zenoh edge, and a function that connects the former: register MQTT handlers before."""
        clock = SystemClock()
        own = self.test_credentials
        mqtt = MqttEdge(self.mosquitto.url, "test", clock, site="test", credentials=own)
        tasks: list[asyncio.Task[None]] = []
        async with AsyncExitStack() as stack:
            zenoh = await stack.enter_async_context(
                ZenohEdge.open(
                    connect=[self.router.endpoint], clock=clock, role="test", id="test", site="test", credentials=own
                )
            )
            yield mqtt, zenoh, lambda: tasks.append(asyncio.create_task(mqtt.run()))
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def close(self) -> None:
        """Stop everything that was started."""
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


class Proxy:
    """Connects clients to a server, until it is cut: then nothing passes, and nobody is told.

    What comes while `delay_s` is set passes that much later, in its order, each way.
    """

    def __init__(self, port: int) -> None:
        self.delay_s = 0.0
        self._target = port
        self._server: asyncio.Server | None = None
        self._through = asyncio.Event()
        self._through.set()
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()

    async def start(self) -> int:
        """Listen; return the port."""
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        return self._server.sockets[0].getsockname()[1]

    def cut(self) -> None:
        self._through.clear()

    def heal(self) -> None:
        """Let data pass again; what was connected when it was cut is disconnected, as after a long partition."""
        self._through.set()
        for writer in self._writers:
            writer.close()

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
        while self._tasks:
            task = self._tasks.pop()
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        for writer in self._writers:
            writer.transport.abort()
        await asyncio.sleep(0)

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        self._tasks.add(asyncio.create_task(self._serve(reader, writer)))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await self._through.wait()
        try:
            there_reader, there_writer = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:
            writer.close()
            return
        self._writers.add(there_writer)
        for source, sink in ((reader, there_writer), (there_reader, writer)):
            self._tasks.add(asyncio.create_task(self._pump(source, sink)))

    async def _pump(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        late: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
        passing = asyncio.create_task(self._pass_on(late, sink))
        try:
            with suppress(OSError):
                while data := await source.read(65536):
                    late.put_nowait((time.monotonic() + self.delay_s, data))
            late.put_nowait((0.0, b""))
            await passing
        finally:
            passing.cancel()

    async def _pass_on(self, late: asyncio.Queue[tuple[float, bytes]], sink: asyncio.StreamWriter) -> None:
        try:
            while True:
                due, data = await late.get()
                await asyncio.sleep(max(0.0, due - time.monotonic()))
                await self._through.wait()
                if not data:
                    return
                sink.write(data)
                await sink.drain()
        except OSError:
            pass
        finally:
            sink.close()


async def until(condition: Callable[[], object], expected: str, details: Callable[[], str] = str) -> None:
    """Wait until a condition is true; after the deadline, fail with what was `expected` and the `details`."""
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"not within {DEADLINE_S:.0f} s: {expected}\n{details()}"
        await asyncio.sleep(0.01)


@pytest.fixture(name="until", scope="session")
def until_fixture():
    return until


@pytest.fixture(name="tokens")
def tokens_fixture() -> dict[str, dict[str, str]]:
    return {role: {"Authorization": f"Bearer {token}"} for _, role, token in TOKENS}


@pytest.fixture
async def proxy_of() -> AsyncIterator[Callable[[Server], Proxy]]:
    """Yield a function that makes a proxy in front of a server; it listens once its test starts it."""
    made: list[Proxy] = []

    def make(server: Server) -> Proxy:
        made.append(Proxy(server.port))
        return made[-1]

    yield make
    for proxy in made:
        await proxy.close()


@pytest.fixture
def proxy(fog: Fog, proxy_of: Callable[[Server], Proxy]) -> Proxy:
    """Return a proxy in front of Redis; it listens once its test starts it."""
    return proxy_of(fog.redis)


@pytest.fixture(scope="session")
def servers_pool(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServersPool]:
    pool = ServersPool(lambda: tmp_path_factory.mktemp("servers"))
    try:
        yield pool
    finally:
        pool.close()


@contextmanager
def running_fog(folder: Path, pool: ServersPool, *modules: str) -> Iterator[Fog]:
    with pool.lend() as servers:
        running = Fog(folder, servers)
        try:
            for module in modules:
                running.start(module)
            yield running
        finally:
            running.close()


@pytest.fixture
def fog(tmp_path: Path, servers_pool: ServersPool) -> Iterator[Fog]:
    with running_fog(tmp_path, servers_pool) as running:
        yield running


@pytest.fixture(scope="module")
def shared_fog(tmp_path_factory: pytest.TempPathFactory, servers_pool: ServersPool) -> Iterator[Fog]:
    """Yield a fog with a running map-service, shared by the tests of a module that kill and restart nothing."""
    with running_fog(tmp_path_factory.mktemp("fog"), servers_pool, "map_service") as running:
        yield running


@pytest.fixture(scope="module")
def open_fog() -> Iterator[Callable[[Path], Fog]]:
    """Yield a function that makes a fog in a folder, whose servers admit everybody, unencrypted."""
    with ExitStack() as stack:

        def make(folder: Path) -> Fog:
            servers = Servers(folder, secured=False)
            stack.callback(servers.close)
            running = Fog(folder, servers)
            stack.callback(running.close)
            return running

        yield make


@pytest.fixture(scope="module")
def shared_open_fog(tmp_path_factory: pytest.TempPathFactory, open_fog: Callable[[Path], Fog]) -> Fog:
    """Return as `shared_fog` one whose servers admit everybody, unencrypted: for tests that change what they send."""
    running = open_fog(tmp_path_factory.mktemp("fog"))
    running.start("map_service")
    return running


@pytest.fixture(scope="module")
def all_services(tmp_path_factory: pytest.TempPathFactory, servers_pool: ServersPool) -> Iterator[Fog]:
    """Yield a fog in which all services run, shared by the tests of a module that kill and restart nothing."""
    with running_fog(
        tmp_path_factory.mktemp("fog"), servers_pool, "hazard_aggregator", "map_service", "planner"
    ) as running:
        yield running
