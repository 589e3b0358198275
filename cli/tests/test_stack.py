import asyncio
import os
import stat
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest

from fog_supervisor import net
from fognav.programs import BROKER, REDIS, ROUTER, SERVERS, WATCHDOG
from fognav.stack import Stack, StackConfig

if TYPE_CHECKING:
    from fog_supervisor.supervisor import Event

pytestmark = pytest.mark.live
TIMEOUT_S = 60.0


@pytest.fixture
async def stack(tmp_path: Path) -> AsyncIterator[Stack]:
    """A stack without running processes; the servers started by the tests do not read its site."""
    async with Stack(StackConfig(site_dir=tmp_path, robot="r1")) as stack:
        yield stack


async def start_servers(stack: Stack) -> None:
    for name in SERVERS:
        stack.supervisor.start(name)
    await stack.supervisor.wait_ready(SERVERS, TIMEOUT_S)


async def wait_restarted(stack: Stack, name: str) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while stack.supervisor.starts(name) < 2:
        assert time.monotonic() < deadline, f"{name} was not restarted"
        await asyncio.sleep(0.02)


async def test_two_stacks_run_side_by_side_and_remove_everything(tmp_path: Path) -> None:
    config = StackConfig(site_dir=tmp_path, robot="r1")
    async with Stack(config) as one, Stack(config) as two:
        await asyncio.gather(start_servers(one), start_servers(two))
        ports = [one.mqtt_port, one.redis_port, one.zenoh_port, two.mqtt_port, two.redis_port, two.zenoh_port]
        assert len(set(ports)) == 6
        pids = [*one.pids().values(), *two.pids().values()]
        assert len(pids) == 6
        folders = (one.folder, two.folder)
    assert not any(psutil.pid_exists(pid) for pid in pids)
    assert not any(folder.exists() for folder in folders)
    assert [await net.server_problem(port) is None for port in ports] == [False] * 6


@pytest.mark.parametrize("name", SERVERS)
async def test_killed_server_restarts_on_its_port(tmp_path: Path, name: str) -> None:
    events: list[Event] = []
    async with Stack(StackConfig(site_dir=tmp_path, robot="r1"), events.append) as stack:
        stack.supervisor.start(name)
        await stack.supervisor.wait_ready([name], TIMEOUT_S)
        first = stack.supervisor.kill(name)
        await wait_restarted(stack, name)
        await stack.supervisor.wait_ready([name], TIMEOUT_S)
        assert stack.supervisor.pid(name) != first
    assert [event.kind for event in events] == ["started", "killed", "exited", "started", "stopped"]


async def test_redis_keeps_acknowledged_writes_when_killed(stack: Stack) -> None:
    stack.supervisor.start(REDIS)
    await stack.supervisor.wait_ready([REDIS], TIMEOUT_S)
    assert await net.server_problem(stack.redis_port, b"SET zone kept\r\n", b"+OK") is None
    stack.supervisor.kill(REDIS)
    await wait_restarted(stack, REDIS)
    await stack.supervisor.wait_ready([REDIS], TIMEOUT_S)
    assert await net.server_problem(stack.redis_port, b"GET zone\r\n", b"$4\r\nkept") is None


async def test_servers_listen_only_on_the_loopback_address(stack: Stack) -> None:
    await start_servers(stack)
    for name in (BROKER, REDIS, ROUTER):
        pid = stack.pids()[name]
        listening = [c.laddr.ip for c in psutil.Process(pid).net_connections("tcp") if c.status == psutil.CONN_LISTEN]
        assert listening == ["127.0.0.1"], name


async def test_keys_and_tokens_are_private_and_differ_between_stacks(tmp_path: Path) -> None:
    config = StackConfig(site_dir=tmp_path, robot="r1")
    async with Stack(config) as one, Stack(config) as two:
        for name in ("operator.key", "tokens.toml"):
            assert stat.S_IMODE((one.folder / name).stat().st_mode) == 0o600
            assert (one.folder / name).read_text() != (two.folder / name).read_text()
        assert one.token not in (one.folder / "tokens.toml").read_text()
        assert stat.S_IMODE(one.folder.stat().st_mode) == 0o700


async def test_settings_of_the_shell_do_not_reach_the_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FOGNAV_HTTP_PORT", "80")
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    async with Stack(StackConfig(site_dir=tmp_path, robot="r1")) as stack:
        stack.supervisor.start(ROUTER)
        await stack.supervisor.wait_ready([ROUTER], TIMEOUT_S)
        environment = psutil.Process(stack.pids()[ROUTER]).environ()
    assert "FOGNAV_HTTP_PORT" not in environment
    assert not environment["PYTHONDONTWRITEBYTECODE"], "each start would compile all modules: empty counts as unset"
    assert os.environ["FOGNAV_HTTP_PORT"] == "80"


async def test_watchdog_of_a_simulated_robot_gets_no_operators_key(tmp_path: Path) -> None:
    async with Stack(StackConfig(site_dir=tmp_path, robot="r1")) as stack:
        stack.supervisor.start(WATCHDOG)
        deadline = time.monotonic() + TIMEOUT_S
        while WATCHDOG not in stack.pids():
            assert time.monotonic() < deadline, "the watchdog was not started"
            await asyncio.sleep(0.02)
        environment = psutil.Process(stack.pids()[WATCHDOG]).environ()
    assert "FOGNAV_GUARDIAN_SOCKET" in environment
    assert "FOGNAV_OPERATOR_KEY_FILE" not in environment
