"""The health of a router: what `/readyz` says of one that serves its clients, and of one that only seems to."""

import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from fog_runtime.credentials import NOBODY, Credentials, to_toml
from fog_runtime.router import AGAIN_S, ANSWERS, OPEN_S, RouterHealth
from fog_runtime.security.site_security import SiteSecurity

ROOT = Path(__file__).parents[3]
LISTENING = re.compile(r'"url": "(http://127\.0\.0\.1:\d+)"')
CHECK_S = 2.0
"""How long a container's check waits."""


@pytest.fixture(scope="module")
def security(tmp_path_factory):
    made = SiteSecurity(tmp_path_factory.mktemp("locks"), "lab")
    made.make(["localhost"])
    return made


@pytest.fixture(scope="module")
def router(security, tmp_path_factory):
    """A locked router that checks itself: its process, and where it says how it is."""
    known = Credentials.read(security.credentials("health"))
    own = tmp_path_factory.mktemp("own") / "health.toml"
    own.write_text(to_toml("health", authority=known.authority, passwords={"zenoh": known.passwords["zenoh"]}))
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    folder = security.folder("zenoh")
    files = {"certificate": "server.pem", "key": "server.key", "users": "users", "access": "access.json5"}
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "fog_runtime.router", f"--listen=tls/127.0.0.1:{port}"),
            *(f"--{option}={folder / file}" for option, file in files.items()),
            *("--health-port=0", f"--health-credentials={own}"),
        ],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    with process:
        lines = iter(process.stdout.readline, "")
        url = next(found[1] for line in lines if (found := LISTENING.search(line)))
        yield process, url, f"tls/localhost:{port}"
        process.terminate()


def condition(answer):
    return answer.json()["parts"][ANSWERS]


def test_router_that_serves_its_clients_is_ready_each_time_it_is_asked(router):
    _, url, _ = router
    for _ in range(3):
        answer = httpx.get(f"{url}/readyz", timeout=30.0)
        assert (answer.status_code, condition(answer)) == (200, {"ok": True, "detail": ""})


def test_stopped_router_gives_no_answer_until_it_goes_on(router):
    process, url, _ = router
    os.kill(process.pid, signal.SIGSTOP)
    try:
        with pytest.raises(httpx.ReadTimeout):
            httpx.get(f"{url}/readyz", timeout=CHECK_S)
    finally:
        os.kill(process.pid, signal.SIGCONT)
    assert httpx.get(f"{url}/readyz", timeout=30.0).status_code == 200


def test_port_that_accepts_connections_and_says_nothing_is_not_ready():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        report = RouterHealth(f"tcp/127.0.0.1:{silent.getsockname()[1]}", NOBODY).report()
    assert not report["ready"]
    assert f"no session within {OPEN_S:g} s" in report["parts"][ANSWERS]["detail"]


def test_router_that_refuses_the_check_s_password_is_not_ready(router, security):
    _, _, endpoint = router
    authority = Credentials.read(security.credentials("health")).authority
    wrong = Credentials("health", passwords={"zenoh": "wrong"}, authority=authority)
    assert not RouterHealth(endpoint, wrong).report()["ready"]


def test_answer_is_good_for_a_while_and_none_is_asked_for_again(router, security):
    _, _, endpoint = router
    health = RouterHealth(endpoint, Credentials.read(security.credentials("health")))
    assert health.report()["ready"]
    with socket.create_server(("127.0.0.1", 0)) as silent:
        health._config = RouterHealth(f"tcp/127.0.0.1:{silent.getsockname()[1]}", NOBODY)._config
        assert health.report()["ready"]
        health._answered_at -= AGAIN_S + 1
        assert not health.report()["ready"]


def test_check_waits_longer_than_the_router_may_take():
    waits = re.search(r"read -r -t (\d+)", (ROOT / "deploy" / "images" / "ready").read_text("utf-8"))
    assert waits is not None
    assert int(waits[1]) == CHECK_S > OPEN_S
