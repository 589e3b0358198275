"""What a planner gets when a robot is sent to a place, and what its answers become."""

import asyncio
import json
import socket
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from fog_supervisor import net
from fog_supervisor.net import put_goal


class Planner(BaseHTTPRequestHandler):
    """Refuses the place `wall`, closes the connection for `none`, and accepts every other one."""

    requests: list

    def do_PUT(self):  # the base class calls it by this name
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.requests.append((self.path, self.headers["Authorization"], body))
        if body["place"] == "none":
            self.connection.shutdown(socket.SHUT_RDWR)
            return
        refused = body["place"] == "wall"
        self.send_response(422 if refused else 200)
        self.end_headers()
        self.wfile.write(json.dumps({"detail": "the goal is in a wall"} if refused else {}).encode())

    def log_message(self, *_arguments):
        """Say nothing."""


@pytest.fixture
def planner():
    Planner.requests = []
    with HTTPServer(("127.0.0.1", 0), Planner) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_planner_gets_the_place_and_the_token(planner):
    assert put_goal(planner, "r1", "b", "secret").status == 200
    assert Planner.requests == [("/api/v1/robots/r1/goal", "Bearer secret", {"place": "b"})]


def test_refusal_is_an_answer_with_its_reason(planner):
    answer = put_goal(planner, "r1", "wall", "secret")
    assert (answer.status, answer.reason) == (422, "the goal is in a wall")


def test_planner_that_closes_the_connection_counts_as_unreachable(planner):
    with pytest.raises(ConnectionError):
        put_goal(planner, "r1", "none", "secret")


@pytest.mark.parametrize("address", ["https://planner:8000", "planner:8000", "http://"])
def test_token_is_not_sent_to_an_address_that_was_not_meant(address):
    with pytest.raises(ValueError, match="must look like http://host:8000"):
        put_goal(address, "r1", "b", "secret")


async def test_cancellation_that_comes_as_a_server_answers_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    answered = asyncio.get_running_loop().create_future()

    async def open_connection(*_arguments: object, **_options: object) -> None:
        await answered

    monkeypatch.setattr(net.asyncio, "open_connection", open_connection)
    asked = asyncio.create_task(net.server_problem(1))
    await asyncio.sleep(0.0)
    answered.set_exception(ConnectionRefusedError())
    await asyncio.sleep(0.0)
    came_in_time = asked.cancel()
    await asyncio.wait({asked})
    assert asked.cancelled() == came_in_time
