"""Locked doors: real servers with certificates and users, clients with credentials, and everybody else."""

import asyncio
import base64
import datetime as dt
import hashlib
import ssl

import aiomqtt
import pytest
from cryptography import x509
from prometheus_client import REGISTRY
from redis.asyncio import Redis

from fog_runtime.certificates import watch_certificates
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.settings import CommonSettings
from fog_runtime.credentials import NOBODY, Credentials, CredentialsError, to_toml
from fog_runtime.lease_store import LeaseStore
from fog_runtime.router import RouterSecurity, RouterSecurityError
from fog_runtime.security import users
from fog_runtime.security.authority import Authority, AuthorityError
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.security.users import SecurityError
from fog_runtime.stores.redis_connection import RedisConnection, StoreError
from fog_runtime.stores.redis_store import RedisStore
from fog_runtime.transports.mqtt_connection import Broker
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor.servers import start_mosquitto, start_redis, start_router

# The client library forgets the socket whose server was not to be trusted; Python closes it, and mentions that.
pytestmark = pytest.mark.filterwarnings(
    "ignore:Exception ignored in. <ssl.SSLSocket:pytest.PytestUnraisableExceptionWarning"
)

HOSTS = ("127.0.0.1", "localhost")
NOW = dt.datetime.now(dt.UTC)


@pytest.fixture(scope="module")
def security(tmp_path_factory):
    made = SiteSecurity(tmp_path_factory.mktemp("locks"), "lab", unrestricted=["test"])
    made.make(HOSTS, robots=["r1", "r2"], nodes=["n1"])
    return made


@pytest.fixture(scope="module")
def stranger(tmp_path_factory):
    """Return credentials for the same names from another authority."""
    made = SiteSecurity(tmp_path_factory.mktemp("stranger"), "lab")
    made.make(HOSTS, robots=["r1"], nodes=["n1"])
    return made


@pytest.fixture(scope="module")
def broker(security, tmp_path_factory):
    with start_mosquitto(tmp_path_factory.mktemp("broker"), security=security.folder("mosquitto")) as server:
        yield server


@pytest.fixture(scope="module")
def router(security, tmp_path_factory):
    with start_router(tmp_path_factory.mktemp("router"), security=security.folder("zenoh")) as server:
        yield server


@pytest.fixture(scope="module")
def redis(security, tmp_path_factory):
    with start_redis(tmp_path_factory.mktemp("redis"), security=security.folder("redis")) as server:
        yield server


def of(security, user):
    return Credentials.read(security.credentials(user))


def changed(credentials, **other):
    """Return credentials of which something is different."""
    known = {"passwords": credentials.passwords, "authority": credentials.authority, **other}
    return Credentials(credentials.user, **known)


async def reaches_broker(url, credentials):
    try:
        async with Broker.of(url, credentials).client(f"{credentials.user}-{id(credentials)}", None):
            return True
    except aiomqtt.MqttError:
        return False


async def reaches_router(endpoint, credentials):
    opened = ZenohEdge.open(
        connect=[endpoint], clock=SystemClock(), role="console", id="x", site="lab", credentials=credentials
    )
    async with opened as edge:
        return edge.connected


async def redis_says(url, credentials, *command):
    connection = RedisConnection(url, timeout_s=5.0, credentials=credentials)
    try:
        (reply,) = await connection.write(command)
    except StoreError as error:
        return str(error)
    finally:
        await connection.aclose()
    return reply


def wrong(credentials, server):
    return changed(credentials, passwords={**credentials.passwords, server: "wrong"})


@pytest.mark.live
async def test_broker_admits_users_of_its_site_and_nobody_else(broker, security, stranger):
    node = of(security, "n1")
    assert await reaches_broker(broker.url, node)
    for refused in (wrong(node, "mqtt"), of(stranger, "n1"), changed(node, authority=of(stranger, "n1").authority)):
        assert not await reaches_broker(broker.url, refused)
    assert not await reaches_broker(broker.url, changed(node, passwords={}))


@pytest.mark.live
async def test_router_admits_users_of_its_site_and_nobody_else(router, security, stranger):
    robot = of(security, "r1")
    assert await reaches_router(router.url, robot)
    plain = router.url.replace("tls/", "tcp/")
    for refused in (wrong(robot, "zenoh"), of(stranger, "r1"), changed(robot, authority=of(stranger, "r1").authority)):
        assert not await reaches_router(router.url, refused)
    assert not await reaches_router(router.url, changed(robot, passwords={}))
    assert not await reaches_router(plain, robot)


@pytest.mark.live
async def test_redis_admits_services_to_their_own_keys_and_nobody_else(redis, security, stranger):
    planner = of(security, "planner")
    assert await redis_says(redis.url, planner, "HSET", "fog:lab:goals", "a", "b") == 1
    for key in ("fog:lab:zones", "fog:lab:areas", "fog:lab:map-service:epoch", "fog:other:goals", "else"):
        assert "permission" in await redis_says(redis.url, planner, "HSET", key, "a", "b"), key
    for command in (("FLUSHALL",), ("CONFIG", "SET", "appendonly", "no"), ("KEYS", "*"), ("ACL", "LIST")):
        assert "permissions" in await redis_says(redis.url, planner, *command), command
    assert "can't run" in await redis_says(redis.url, planner, "EVAL", "return redis.call('flushall')", 0)
    assert "password" in await redis_says(redis.url, wrong(planner, "redis"), "PING")
    assert "certificate" in (await redis_says(redis.url, of(stranger, "planner"), "PING")).lower()
    assert isinstance(await redis_says(redis.url, changed(planner, passwords={}), "PING"), str)
    assert "Redis" in await redis_says(redis.url.replace("rediss", "redis"), planner, "PING")


@pytest.mark.live
async def test_console_service_reads_the_past_in_redis_and_changes_nothing(redis, security):
    planner, console = of(security, "planner"), of(security, "console-service")
    added = await redis_says(redis.url, planner, "XADD", "fog:lab:audit:robot", "*", "who", "anna")
    assert isinstance(added, bytes)
    ((_, found),) = await redis_says(redis.url, console, "XRANGE", "fog:lab:audit:robot", "-", "+")
    assert b"anna" in (found.values() if isinstance(found, dict) else found)
    assert await redis_says(redis.url, console, "XRANGE", "fog:lab:history:hall", "-", "+") == []
    for command in (
        ("XADD", "fog:lab:audit:robot", "*", "who", "nobody"),
        ("XRANGE", "fog:other:audit:robot", "-", "+"),
        ("HGETALL", "fog:lab:zones"),
        ("SET", "fog:lab:console-service:any", "1"),
        ("EVAL", "return 1", 0),
    ):
        assert "permission" in await redis_says(redis.url, console, *command), command
    # The next test has the same server, and reads whole entries.
    assert await redis_says(redis.url, planner, "XDEL", "fog:lab:audit:robot", added) == 1


@pytest.mark.live
async def test_secured_redis_has_after_a_restart_what_it_acknowledged_before(tmp_path):
    security = SiteSecurity(tmp_path / "locks", "lab")
    security.make(HOSTS)
    planner = of(security, "planner")
    script = "redis.call('HSET', KEYS[1], 'a', '1') redis.call('HSET', KEYS[1], 'b', '2') return 1"
    with start_redis(tmp_path / "redis", security=security.folder("redis")) as server:
        assert await redis_says(server.url, planner, "EVAL", script, 1, "fog:lab:goals") == 1
        server.kill()
        server.start()
        assert await redis_says(server.url, planner, "HLEN", "fog:lab:goals") == 2
        for password in ("", "x"):
            nobody = Credentials("default", authority=planner.authority, passwords={"redis": password})
            assert "Redis: " in str(await redis_says(server.url, nobody, "PING"))


@pytest.mark.live
async def test_store_and_lease_need_no_more_than_a_service_may(redis, security):
    own = of(security, "planner")
    async with (
        RedisStore(redis.url, "lab", service="planner", credentials=own, timeout_s=5.0) as store,
        LeaseStore(redis.url, "lab", "planner", credentials=own) as leases,
    ):
        await store.check()
        assert await store._used_memory() > 1e5
        assert await store.durability_warning() == ""
        assert (await store.audit()).entries == []
        assert leases is not None
    administrator = of(security, "administrator")
    async with Redis(
        port=redis.port, ssl=True, ssl_ca_data=administrator.authority,
        username="administrator", password=administrator.passwords["redis"],
    ) as everything:  # fmt: skip
        for key, right in (("audit:robot", True), ("audit:zone", False)):
            tried = await everything.execute_command(
                "ACL", "DRYRUN", "planner", "XADD", f"fog:lab:{key}", "*", "a", "b"
            )
            assert (tried == b"OK") == right, key


@pytest.mark.live
async def test_authority_is_replaced_without_a_moment_of_distrust(tmp_path):
    security = SiteSecurity(tmp_path / "locks", "lab")
    security.make(HOSTS, robots=["r1"], nodes=["n1"])
    before = of(security, "n1")
    authority = security.authority
    authority.rotate(now=dt.datetime.now(dt.UTC))
    security.trust_again()
    overlap = of(security, "n1")
    with start_mosquitto(tmp_path / "broker", security=security.folder("mosquitto")) as broker:
        assert await reaches_broker(broker.url, before)
        assert await reaches_broker(broker.url, overlap), "a new client and a server with the old certificate"
        assert security.renew(HOSTS, only_due=False) == ["mosquitto", "redis", "zenoh", "http"]
        broker.restart()
        assert await reaches_broker(broker.url, before), "a client of before and a server with the new certificate"
        assert await reaches_broker(broker.url, overlap)
        security.authority.finish()
        security.trust_again()
        after = of(security, "n1")
        assert await reaches_broker(broker.url, after)
        security.renew(HOSTS, only_due=False)
        broker.restart()
        assert await reaches_broker(broker.url, after)
        assert not await reaches_broker(broker.url, before), "the overlap has ended"


def test_rotation_can_neither_be_repeated_nor_finished_twice_and_survives_reopening(tmp_path):
    file = tmp_path / "authority.pem"
    made = Authority.create(file, "Fognav lab", now=NOW)
    first = made.trusted
    with pytest.raises(AuthorityError, match="already"):
        Authority.create(file, "Fognav lab", now=NOW)
    with pytest.raises(AuthorityError, match="nothing to finish"):
        made.finish()
    made.rotate(now=NOW)
    again = Authority.open(file)
    assert again.rotating
    assert again.trusted == made.trusted
    assert first in again.trusted
    assert again.trusted.count("BEGIN CERTIFICATE") == 2
    with pytest.raises(AuthorityError, match="not finished"):
        again.rotate(now=NOW)
    again.finish()
    assert not Authority.open(file).rotating
    assert first not in Authority.open(file).trusted
    assert file.stat().st_mode & 0o077 == 0


def test_certificates_are_valid_for_a_computer_whose_clock_was_never_set(tmp_path):
    security = SiteSecurity(tmp_path, "lab")
    security.make(HOSTS)
    security.authority.rotate(now=NOW)
    security.renew(only_due=False)
    chain = (security.folder("redis") / "server.pem").read_bytes() + security.authority.trusted.encode()
    begins = {each.not_valid_before_utc for each in x509.load_pem_x509_certificates(chain)}
    assert begins == {dt.datetime(1970, 1, 1, tzinfo=dt.UTC)}


def test_certificates_that_expire_soon_are_renewed_and_others_stay(tmp_path):
    security = SiteSecurity(tmp_path, "lab")
    security.make(HOSTS)
    chain = security.folder("redis") / "server.pem"
    kept = chain.read_bytes()
    chain_of_broker = security.folder("mosquitto") / "server.pem"
    chain_of_broker.write_bytes(security.authority.issue("mosquitto", HOSTS, now=NOW, days=10).chain)
    assert security.renew(HOSTS, only_due=True) == ["mosquitto"]
    assert chain.read_bytes() == kept
    assert security.expiries()["mosquitto"] > NOW + dt.timedelta(days=700)


def test_certificates_that_end_with_their_authority_are_not_issued_again_at_each_look(tmp_path):
    Authority.create(tmp_path / "authority.pem", "lab", now=NOW - dt.timedelta(days=3600))
    security = SiteSecurity(tmp_path, "lab")
    assert security.renew(HOSTS, only_due=True) == ["mosquitto", "redis", "zenoh", "http"]
    assert security.renew(only_due=True) == []
    assert set(security.expiring()) == {"authority", "mosquitto", "redis", "zenoh", "http"}


async def test_until_when_certificates_are_valid_is_exported_of_each_server_even_when_it_has_ended(
    security, broker, redis, router, tmp_path
):
    ended = security.authority.issue("gateway", HOSTS, now=NOW, days=-1)
    (tmp_path / "server.pem").write_bytes(ended.chain)
    (tmp_path / "server.key").write_bytes(ended.key)
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(tmp_path / "server.pem", tmp_path / "server.key")
    gateway = await asyncio.start_server(lambda _reader, writer: writer.close(), "127.0.0.1", 0, ssl=tls)
    old = f"127.0.0.1:{gateway.sockets[0].getsockname()[1]}"
    settings = CommonSettings(
        site_dir=tmp_path, data_dir=tmp_path, mqtt_url=f"{broker.url},mqtts://{old}", redis_url=redis.url,
        zenoh_connect=router.endpoint,
    )  # fmt: skip
    known = Credentials.read(security.credentials("map-service"))
    watching = asyncio.create_task(watch_certificates(settings, known))
    places = {f"127.0.0.1:{server.port}" for server in (broker, redis, router)} | {old, "authority"}

    def ends():
        return {
            each: REGISTRY.get_sample_value("fognav_certificate_end_seconds", {"certificate": each}) for each in places
        }

    try:
        async with asyncio.timeout(60.0):
            while None in ends().values():  # noqa: ASYNC110  # a metric tells nobody unasked
                await asyncio.sleep(0.01)
    finally:
        watching.cancel()
        gateway.close()
    files = security.expiries()
    assert ends() == {
        f"127.0.0.1:{broker.port}": files["mosquitto"].timestamp(),
        f"127.0.0.1:{redis.port}": files["redis"].timestamp(),
        f"127.0.0.1:{router.port}": files["zenoh"].timestamp(),
        old: pytest.approx((NOW - dt.timedelta(days=1)).timestamp(), abs=1.0),
        "authority": files["authority"].timestamp(),
    }


def test_making_locks_again_changes_no_password_even_of_a_robot_whose_file_was_handed_out(tmp_path):
    security = SiteSecurity(tmp_path, "lab")
    security.make(HOSTS, robots=["r1"])
    security.credentials("r1").unlink()
    before = (security.folder("zenoh") / "users").read_text()
    security.make(HOSTS, robots=["r1"])
    assert (security.folder("zenoh") / "users").read_text() == before
    assert not security.credentials("r1").exists()


def test_users_whom_the_servers_lists_lack_are_admitted_again_with_the_passwords_of_their_credentials(tmp_path):
    security = SiteSecurity(tmp_path, "lab")
    security.make(HOSTS)
    older = {program: (security.folder(program) / "users").read_text() for program in ("mosquitto", "redis", "zenoh")}
    security.add_floor("upstairs", robots=["r1"])
    service = Credentials.read(security.credentials("upstairs.map-service")).passwords
    robot = Credentials.read(security.credentials("upstairs.r1")).passwords
    for program, text in older.items():
        (security.folder(program) / "users").write_text(text)
    security.make(HOSTS)
    security.add_floor("upstairs", robots=["r1"])
    listed = (security.folder("zenoh") / "users").read_text().splitlines()
    assert f"upstairs.map-service:{service['zenoh']}" in listed
    assert f"upstairs.r1:{robot['zenoh']}" in listed
    for program in ("mosquitto", "redis"):
        assert "upstairs.map-service" in (security.folder(program) / "users").read_text()
    assert Credentials.read(security.credentials("upstairs.map-service")).passwords == service


def test_hashes_of_an_earlier_version_are_replaced_by_such_as_the_broker_checks_quickly(tmp_path, monkeypatch):
    def listed():
        lines = (security.folder("mosquitto") / "users").read_text().splitlines()
        return {user: hashed.split("$") for user, _, hashed in (line.partition(":") for line in lines)}

    security = SiteSecurity(tmp_path, "lab")
    with monkeypatch.context() as earlier:
        earlier.setattr(users, "_ITERATIONS", 20_000)
        security.make(HOSTS, nodes=["n1"])
    before = listed()
    security.credentials("n1").unlink()  # its board alone knows its password
    security.make(HOSTS, nodes=["n1"])
    after = listed()
    assert after.keys() == before.keys()
    assert after.pop("n1") == before["n1"]
    for user, (_, kind, iterations, salt, hashed) in after.items():
        assert (kind, iterations) == ("7", "101")
        password = Credentials.read(security.credentials(user)).passwords["mqtt"].encode()
        expected = hashlib.pbkdf2_hmac("sha512", password, base64.b64decode(salt), 101)
        assert base64.b64decode(hashed) == expected


def test_a_robot_is_added_replaced_and_removed(tmp_path):
    security = SiteSecurity(tmp_path, "lab")
    security.make(HOSTS)
    first = Credentials.read(security.add_robot("r7"))
    assert '"fog/lab/robots/r7/pose"' in (security.folder("zenoh") / "access.json5").read_text()
    second = Credentials.read(security.add_robot("r7"))
    users = (security.folder("zenoh") / "users").read_text().splitlines()
    assert [line for line in users if line.startswith("r7:")] == [f"r7:{second.passwords['zenoh']}"]
    assert first.passwords != second.passwords
    assert security.remove("r7")
    assert not security.remove("r7")
    assert "r7" not in (security.folder("zenoh") / "access.json5").read_text()
    with pytest.raises(SecurityError, match="name of a part"):
        security.add_robot("planner")


def test_a_device_keeps_its_topics_when_credentials_are_made_again_and_loses_them_with_its_user(tmp_path):
    security = SiteSecurity(tmp_path / "locks", "lab")
    security.make(["localhost"], nodes=["n1"])
    security.add_device("z2m", ["zigbee2mqtt/#"])
    access = security.folder("mosquitto") / "access"
    SiteSecurity(tmp_path / "locks", "lab").make(["fog.local"])
    SiteSecurity.open(tmp_path / "locks").add_node("n2")
    assert "user z2m\ntopic readwrite zigbee2mqtt/#\n" in access.read_text()
    assert SiteSecurity.open(tmp_path / "locks").remove("z2m")
    assert "z2m" not in access.read_text()


@pytest.mark.parametrize("name", ["default", "planner", "administrator", "health"])
def test_no_part_of_fognav_is_removed_and_redis_goes_on_to_refuse_who_gives_no_name(tmp_path, name):
    security = SiteSecurity(tmp_path / "locks", "lab")
    security.make(["localhost"])
    with pytest.raises(SecurityError, match=f"{name} is the name of a part"):
        security.remove(name)
    with pytest.raises(SecurityError, match=f"{name} is the name of a part"):
        security.make(["localhost"], robots=[name])
    file = security.folder("redis") / "users"
    file.write_text("".join(line for line in file.read_text().splitlines(keepends=True) if "default" not in line))
    security.make(["localhost"])
    assert file.read_text().splitlines().count(users.REDIS_NOBODY) == 1


def test_robot_and_node_of_the_same_id_are_refused_before_one_of_them_loses_its_password(tmp_path):
    security = SiteSecurity(tmp_path / "locks", "lab")
    with pytest.raises(SecurityError, match=r"^x1: a robot, a node and a device of one site need different ids"):
        security.make(["localhost"], robots=["x1", "r1"], nodes=["x1"])
    security.make(["localhost"], robots=["x1"])
    with pytest.raises(SecurityError, match=r"^x1: a robot"):
        security.add_node("x1")


@pytest.mark.parametrize(
    ("name", "topic"),
    [
        ("n1", "zigbee2mqtt/#"), ("planner", "zigbee2mqtt/#"), ("z2m", "#"), ("z2m", "+/#"), ("z2m", "WSN"),
        ("z2m", "fog/v1/lab/#"), ("z2m", "zigbee2mqtt/#/state"), ("z2m", "$SYS/#"),
        ("z2m", "a/b\nuser planner\ntopic #"),
    ],
)  # fmt: skip
def test_a_device_gets_no_name_and_no_topic_of_others(tmp_path, name, topic):
    security = SiteSecurity(tmp_path / "locks", "lab")
    security.make(["localhost"], nodes=["n1"])
    before = (security.folder("mosquitto") / "access").read_text()
    with pytest.raises(SecurityError, match=name):
        security.add_device(name, [topic])
    assert (security.folder("mosquitto") / "access").read_text() == before
    security.add_device("lidar-gate", ["gate/+/state"])
    with pytest.raises(SecurityError, match=r"^lidar-gate: a robot"):
        security.add_node("lidar-gate")


def test_no_file_holds_a_password_that_another_server_accepts(security):
    """A server that was broken into gives away no password for another one."""
    planner = of(security, "planner")
    assert len(set(planner.passwords.values())) == 2
    router = (security.folder("zenoh") / "users").read_text()
    assert planner.passwords["zenoh"] in router
    assert planner.passwords["redis"] not in router
    for program in ("mosquitto", "redis"):
        text = (security.folder(program) / "users").read_text()
        assert not any(password in text for password in of(security, "map-service").passwords.values())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("user = ", "not valid TOML"),
        ("nobody = 1", "unknown field"),
        ("user = 'x'\n[passwords]\nhttp = 'p'", "passwords"),
        ("user = 'x'\nauthority = 'certificate'", "can't be used"),
        (None, "can't be read"),
    ],
)
def test_unusable_credentials_are_named_with_the_remedy(tmp_path, text, expected):
    file = tmp_path / "r1.toml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(CredentialsError, match=expected) as raised:
        Credentials.read(file)
    assert str(file) in str(raised.value)
    assert "Copy it from the fog node" in str(raised.value)


def test_credentials_are_read_as_they_were_written(tmp_path, security):
    authority = security.authority.trusted
    file = tmp_path / "x.toml"
    file.write_text(to_toml('a "b"', authority=authority, passwords={"mqtt": "p'\"\\"}, token="t"))
    found = Credentials.read(file)
    assert (found.user, found.passwords, found.token) == ('a "b"', {"mqtt": "p'\"\\"}, "t")
    assert found.authority.strip() == authority.strip()
    assert isinstance(found.tls_context(), ssl.SSLContext)


async def test_no_password_leaves_this_computer_unencrypted():
    known = Credentials("x", passwords={"mqtt": "p", "zenoh": "p", "redis": "p"})
    for url in ("mqtt://fog:1883", "mqtt://192.168.7.1", "mqtts://fog,mqtt://fog"):
        with pytest.raises(CredentialsError, match="mqtts://HOST"):
            MqttEdge(url, "x", SystemClock(), site="lab", credentials=known)
    with pytest.raises(CredentialsError, match="rediss://HOST"):
        RedisConnection("redis://fog:6379/0", credentials=known)
    with pytest.raises(CredentialsError, match="tls/HOST"):
        async with ZenohEdge.open(
            connect=["tls/fog:7447", "tcp/fog:7447"], clock=SystemClock(), role="planner", id="x", site="lab",
            credentials=known,
        ):  # fmt: skip
            pass
    MqttEdge("mqtt://127.0.0.1", "x", SystemClock(), site="lab", credentials=known)
    MqttEdge("mqtt://fog", "x", SystemClock(), site="lab", credentials=NOBODY)


def test_router_names_a_file_that_is_missing(tmp_path):
    with pytest.raises(RouterSecurityError, match="users does not exist"):
        RouterSecurity(users=tmp_path / "users").config(["tcp/127.0.0.1:1"], [])
