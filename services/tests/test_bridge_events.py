"""The floor as the bridges see it by its console: its events, and what becomes of their requests."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from contextlib import aclosing, suppress

import httpx
import msgspec
import pytest
from vda5050_floor import A, B, Floorplan, instant, order

from console_service.log import frame
from fog_bridges.floor import Floor, whole_lines
from fog_contracts import channels as ch
from fog_contracts.messages import RobotState


class Heard:
    """An adapter that keeps what it is told."""

    name, problem = "heard", ""

    def __init__(self, until: str) -> None:
        self.told: list[tuple[str, object]] = []
        self.done = asyncio.Event()
        self._until = until

    def on_event(self, name: str, data: dict[str, object]) -> None:
        self.told.append((name, data.get("reason")))
        if name == self._until:
            self.done.set()

    def on_lost(self) -> None:
        self.told.append(("lost", None))
        self.done.set()


async def test_events_are_read_whatever_characters_words_of_operators_have_and_however_they_arrive():
    words = "wet\u2028until\u2029noon\x85\x0b\x0c\x1c: ä"
    body = b"".join(
        frame(name, msgspec.json.encode({"reason": words}), "r.7") for name in ("hello", "zone", "ready")
    ).replace(b"\n\n", b"\r\n\r\n", 1)
    assert "\u2028".encode() in body, "the console writes it as it is"

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nTransfer-Encoding: chunked\r\n\r\n")
        for byte in body:
            writer.write(b"1\r\n%c\r\n" % byte)
        await writer.drain()
        writer.close()
        await writer.wait_closed()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        floor, heard = Floor(f"http://127.0.0.1:{port}", "token", trusted=True), Heard("ready")
        following = asyncio.create_task(floor.follow([heard]))
        await asyncio.wait_for(heard.done.wait(), 10.0)
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)
        await floor.aclose()
    assert heard.told[:3] == [(name, words) for name in ("hello", "zone", "ready")]


async def test_line_without_an_end_fills_no_memory():
    async def endless():
        while True:
            yield b"data: " + b"x" * 60

    with pytest.raises(httpx.DecodingError, match="more than 1000 bytes"):
        await anext(whole_lines(endless(), 1000))


# --- Its requests -----------------------------------------------------------------------------------------------------


@pytest.mark.live
@pytest.mark.timeout(180)
@pytest.mark.parametrize("silent", ["planner", "redis"])
async def test_cancel_that_a_fleet_control_is_told_is_done_leaves_no_mission_behind_though_the_floor_was_silent(
    all_services, tokens, silent
):
    urls = {
        name: await all_services.ready(module)
        for name, module in (("AGGREGATOR", "hazard_aggregator"), ("MAP", "map_service"), ("PLANNER", "planner"))
    }
    all_services.start("console_service", **{f"FOGNAV_{name}_URL": url for name, url in urls.items()})
    console, operator = await all_services.ready("console_service"), tokens["operator"]
    pid = all_services.processes["planner"].pid if silent == "planner" else all_services.redis.pid
    fleet = Floorplan()
    fleet.tell(time.monotonic() - fleet.now)
    assert fleet.take(order(A, B)) == ""
    async with (
        all_services.edges() as (_, zenoh, _connect),
        aclosing(Floor(console, operator["Authorization"].removeprefix("Bearer "), trusted=True)) as floor,
        httpx.AsyncClient(base_url=urls["PLANNER"], headers=operator, timeout=30.0) as planner,
    ):
        state = RobotState(
            mode="HOLD", reasons=[], enabled=True, battery=None, goal_id=None, map_epoch=1, map_seq=0, plan_id=None
        )
        while (await planner.get("/api/v1/robots/r1")).status_code != 200:
            zenoh.publish(ch.ROBOT_STATE, state, robot="r1")
            await asyncio.sleep(0.1)

        async def step() -> None:
            """Let a second pass: the floor says what mission there is, and answers what is asked."""
            await asyncio.sleep(1.0)
            with suppress(httpx.TimeoutException):
                fleet.goal = (await planner.get("/api/v1/robots/r1", timeout=0.5)).json()["goal"]
            fleet.tell(time.monotonic() - fleet.now)
            if (request := fleet.robot.step(fleet.now)) is not None:
                fleet.robot.on_answer(await floor.ask(request), time.monotonic())

        os.kill(pid, signal.SIGSTOP)
        stopped_at = time.monotonic()
        try:
            request = fleet.robot.step(fleet.now)
            answer = await floor.ask(request)
            assert answer.problem in ("", "store_uncertain"), answer
            fleet.tell(time.monotonic() - fleet.now)
            fleet.robot.on_answer(answer, fleet.now)
            fleet.robot.on_instant(instant("cancelOrder", "c"), fleet.now)
            while time.monotonic() < stopped_at + 12.0:
                await step()
        finally:
            os.kill(pid, signal.SIGCONT)
        assert fleet.robot.instant["c"].action_status == "RUNNING"
        while fleet.robot.instant["c"].action_status == "RUNNING":
            await step()
        assert fleet.robot.instant["c"].action_status == "FINISHED"
        assert (await planner.get("/api/v1/robots/r1")).json()["goal"] is None
    all_services.kill("console_service")
