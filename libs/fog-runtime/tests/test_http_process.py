"""The process that receives requests: what reaches the core, and how both end."""

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
import time

import httpx
import msgspec
import pytest
from fastapi import Response

from fog_contracts.messages import Zone
from fog_runtime.health import Health
from fog_runtime.http import (
    Body,
    ClientHost,
    Encoded,
    HttpProcess,
    HttpProcessError,
    ProblemCode,
    ProblemError,
    Routes,
    Tokens,
    app,
    make_app,
    unused,
)
from fog_runtime.http.link import CoreLink, HttpLink

pytestmark = pytest.mark.live
DEADLINE_S = 60.0
ALONE = """
import asyncio, pathlib, sys
from fog_runtime.health import Health
from fog_runtime.http import HttpProcess, Tokens, make_app
async def main():
    make = lambda: make_app("Test", Health(), Tokens())
    await HttpProcess.fork(make).serve(make(), pathlib.Path(sys.argv[1]))
asyncio.run(main())
"""


class Gone(ProblemCode):
    GONE = "gone", 410, "It is gone"


class Service:
    """The core's side of a small app, on the test's event loop."""

    def __init__(self, folder) -> None:
        self.calls: list[str] = []
        self.called = asyncio.Event()
        self.release = asyncio.Event()
        self.pids: set[int] = set()
        self.http_process = HttpProcess.fork(lambda: self.make(unused()))
        self.app = self.make(self)
        self.port_file = folder / "port"
        self.task = asyncio.create_task(self.http_process.serve(self.app, self.port_file))

    @staticmethod
    def make(service):
        made = make_app("Test", Health(), Tokens(), body_limit=10_000)
        routes = Routes(made, "test")

        @routes.put("/zones/{zone}")
        async def zones(zone: str, body: Body[Zone]) -> Zone:
            service.calls.append(zone)
            service.pids.add(os.getpid())
            return body

        @routes.get("/slow")
        async def slow() -> str:
            service.called.set()
            await service.release.wait()
            return "done"

        routes.urgent("/robots/{robot}/stop")

        @routes.post("/robots/{robot}/stop")
        async def stop(robot: str) -> str:
            return await service.stop(robot)

        @routes.get("/bug")
        async def bug() -> str:
            raise RuntimeError("inner detail")

        @routes.get("/gone", problems=[Gone.GONE])
        async def gone() -> str:
            raise ProblemError(Gone.GONE, "it is gone", headers={"X-Since": "monday"}, since=7)

        @routes.get("/encoded")
        async def encoded() -> Encoded[list[int]]:
            return Encoded(b"[1,2]")

        @routes.get("/number")
        async def number(value: int) -> int:
            return value

        @routes.put("/number")
        async def put_number(body: Body[int]) -> int:
            return body

        @routes.get("/client")
        async def client(host: ClientHost) -> str:
            return host

        return made

    async def stop(self, robot: str) -> str:
        if robot == "silent":
            await self.release.wait()
        return robot

    async def url(self) -> str:
        async with asyncio.timeout(DEADLINE_S):
            while not self.port_file.exists():  # noqa: ASYNC110  # another program's file
                await asyncio.sleep(0.01)
        return f"http://127.0.0.1:{self.port_file.read_text().strip()}"

    async def close(self) -> None:
        self.task.cancel()
        await asyncio.gather(self.task, return_exceptions=True)


@contextlib.asynccontextmanager
async def serving(folder):
    service = Service(folder)
    try:
        async with httpx.AsyncClient(base_url=await service.url(), timeout=DEADLINE_S) as client:
            yield service, client
    finally:
        await service.close()


ZONE = {"id": "z1", "kind": "BLOCKED", "shape": {"type": "circle", "centre": [1, 2], "radius": 1}}


async def test_handlers_run_in_the_cores_process_with_the_decoded_arguments(tmp_path):
    async with serving(tmp_path) as (service, client):
        answer = await client.put("/zones/z1", json=ZONE)
        assert msgspec.json.decode(answer.content, type=Zone) == msgspec.convert(ZONE, Zone)
        assert (service.calls, service.pids) == (["z1"], {os.getpid()})
        assert (await client.get("/encoded")).json() == [1, 2]
        assert (await client.get("/client")).json() == "127.0.0.1"


async def test_invalid_requests_do_not_reach_the_core(tmp_path):
    async with serving(tmp_path) as (service, client):
        assert (await client.put("/zones/z1", content=b"[" * 9_000)).status_code == 422
        assert (await client.put("/zones/z1", json={**ZONE, "kind": "SOFT"})).status_code == 422
        deep = await client.put("/zones/z1", content=b'{"unknown": ' + b"[" * 4_900 + b"]" * 4_900 + b"}")
        assert (deep.status_code, deep.json()["errors"][0]["field"]) == (422, "body")
        assert (await client.put("/zones/z1", content=b"x" * 10_001)).status_code == 413
        assert (await client.get("/nowhere")).status_code == 404
        assert service.calls == []


@pytest.mark.parametrize("number", [2**64, -(2**63) - 1, 10**20])
async def test_integer_that_the_link_can_not_carry_is_refused_and_the_largest_arrive(tmp_path, number):
    async with serving(tmp_path) as (_, client):
        for answer in (await client.get(f"/number?value={number}"), await client.put("/number", content=str(number))):
            assert (answer.status_code, answer.headers["content-type"]) == (422, "application/problem+json")
            assert "64 bits" in answer.json()["detail"]
        for possible in (2**64 - 1, -(2**63)):
            assert (await client.get(f"/number?value={possible}")).json() == possible


async def test_errors_of_handlers_become_problems_with_their_headers_and_members(tmp_path):
    async with serving(tmp_path) as (_, client):
        gone = await client.get("/gone")
        assert (gone.status_code, gone.headers["x-since"], gone.json()["since"]) == (410, "monday", 7)
        assert gone.headers["content-type"] == "application/problem+json"
        bug = await client.get("/bug")
        assert (bug.status_code, bug.json()["detail"]) == (500, "the service failed: see its log for the reason")


async def test_body_that_does_not_arrive_is_refused_after_a_while(tmp_path, monkeypatch):
    monkeypatch.setattr(app, "BODY_S", 0.2)
    async with serving(tmp_path) as (service, client):
        reader, writer = await asyncio.open_connection("127.0.0.1", client.base_url.port)
        writer.write(b"PUT /zones/z1 HTTP/1.1\r\nHost: fog\r\nContent-Length: 100\r\n\r\n{")
        assert b" 408 " in await asyncio.wait_for(reader.readline(), DEADLINE_S)
        writer.close()
        assert service.calls == []


async def test_client_whose_requests_take_long_leaves_places_to_others_and_to_stops(tmp_path, monkeypatch):
    monkeypatch.setattr(app, "MAX_OF_CLIENT", 3)
    monkeypatch.setattr(app, "MAX_URGENT_OF_PATH", 2)
    async with serving(tmp_path) as (service, client), asyncio.TaskGroup() as tasks:

        async def until_refused(method: str, path: str) -> httpx.Response:
            """Open requests, which are answered after the release only, until one more is refused."""
            open_requests = set()
            while True:
                open_requests.add(tasks.create_task(client.request(method, path)))
                answered, open_requests = await asyncio.wait(open_requests, timeout=0.1)
                if answered:
                    return answered.pop().result()

        refused = await until_refused("GET", "/slow")
        assert (refused.status_code, refused.headers["retry-after"]) == (503, "1")
        assert refused.headers["connection"] == "close"
        assert refused.headers["content-type"] == "application/problem+json"
        assert "3 of your requests are being served" in refused.json()["detail"]
        assert (await client.get("/readyz")).status_code == 200
        other = httpx.AsyncHTTPTransport(local_address="127.0.0.2")
        async with httpx.AsyncClient(transport=other, base_url=client.base_url) as neighbour:
            assert (await neighbour.get("/encoded")).status_code == 200
        refused = await until_refused("POST", "/robots/silent/stop")
        assert "2 such requests are being served" in refused.json()["detail"]
        assert (await client.post("/robots/r1/stop")).json() == "r1"
        service.release.set()


async def test_client_that_asks_for_health_too_often_at_once_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(app, "MAX_HEALTH_OF_CLIENT", 0)
    async with serving(tmp_path) as (_, client):
        assert (await client.get("/metrics")).status_code == 503
        assert (await client.get("/encoded")).status_code == 200


async def test_client_that_ends_none_of_its_requests_takes_no_place(tmp_path, monkeypatch):
    monkeypatch.setattr(app, "MAX_OF_CLIENT", 1)
    monkeypatch.setattr(app, "MAX_URGENT_OF_PATH", 1)
    monkeypatch.setattr(app, "BODY_S", 2 * DEADLINE_S)
    async with serving(tmp_path) as (_, client), contextlib.AsyncExitStack() as connections:
        for begun in (b"PUT /zones/z1", b"POST /robots/r1/stop"):
            reader, writer = await asyncio.open_connection("127.0.0.1", client.base_url.port)
            connections.callback(writer.close)
            writer.write(begun + b" HTTP/1.1\r\nHost: fog\r\nExpect: 100-continue\r\nContent-Length: 100\r\n\r\n")
            assert b" 100 " in await asyncio.wait_for(reader.readline(), DEADLINE_S)  # it waits for the body
            writer.write(b"{")
        assert (await client.get("/encoded")).status_code == 200
        assert (await client.post("/robots/r1/stop")).json() == "r1"


async def test_stop_is_begun_before_whatever_waits_in_the_core():
    core, http_process = socket.socketpair()
    calling, answering = await CoreLink.over(http_process), await HttpLink.over(core)
    begun = []

    async def answer(route: str, _: bytes) -> Response:
        begun.append(route)
        return Response()

    routes = ["GET /metrics"] * 10 + ["GET /robots"] * 10 + ["POST /stop"]
    ranks = {"POST /stop": 0, "GET /robots": 1, "GET /metrics": 2}
    running = [
        asyncio.create_task(calling.run(lambda: None)),
        asyncio.create_task(answering.answer_calls(answer, ranks.__getitem__)),
    ]
    await asyncio.gather(*(calling.call(route, b"") for route in routes))
    assert begun[1:] == sorted(begun[1:], key=ranks.__getitem__)
    assert begun.index("POST /stop") <= 1
    calling._messages.close()
    await asyncio.gather(*running)
    answering.close()


async def test_open_request_is_answered_at_the_end(tmp_path):
    async with serving(tmp_path) as (service, client):
        request = asyncio.create_task(client.get("/slow"))
        await asyncio.wait_for(service.called.wait(), DEADLINE_S)
        ending = asyncio.create_task(service.close())
        await asyncio.sleep(0)
        service.release.set()
        assert (await request).json() == "done"
        await ending


async def test_request_that_never_ends_does_not_hold_up_the_end(tmp_path):
    async with serving(tmp_path) as (service, client):
        request = asyncio.create_task(client.get("/slow"))
        await asyncio.wait_for(service.called.wait(), DEADLINE_S)
        async with asyncio.timeout(DEADLINE_S):
            await service.close()
            (outcome,) = await asyncio.gather(request, return_exceptions=True)
        assert isinstance(outcome, httpx.HTTPError) or outcome.status_code == 500


async def test_end_of_the_http_process_ends_the_service_with_an_error(tmp_path):
    async with serving(tmp_path) as (service, client):
        await client.get("/encoded")
        os.kill(service.http_process._pid, signal.SIGKILL)
        with pytest.raises(HttpProcessError, match="has ended"):
            await service.task


async def test_calls_to_a_core_that_has_ended_are_to_be_repeated():
    core, http_process = socket.socketpair()
    link = await CoreLink.over(http_process)
    running = asyncio.create_task(link.run(lambda: None))
    calling = asyncio.create_task(link.call("GET /slow", b""))
    await asyncio.to_thread(core.recv, 1)
    core.close()
    for call in (calling, link.call("GET /slow", b"")):
        with pytest.raises(ProblemError) as refused:
            await call
        assert (refused.value.code, refused.value.headers) == ("restarted", {"Retry-After": "1"})
        await running


def test_http_process_ends_with_a_killed_core(tmp_path):
    with subprocess.Popen([sys.executable, "-c", ALONE, str(tmp_path / "port")]) as core:
        deadline = time.monotonic() + DEADLINE_S
        while not (tmp_path / "port").exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        port = int((tmp_path / "port").read_text())
        socket.create_connection(("127.0.0.1", port)).close()
        core.kill()
        while time.monotonic() < deadline:
            try:
                socket.create_connection(("127.0.0.1", port)).close()
            except ConnectionRefusedError:
                break
            time.sleep(0.01)
        assert time.monotonic() < deadline, "its HTTP process listens still"
