"""A planner whose core's thread hangs, while its event loop goes on, leaves the lease to one that can plan."""

import asyncio
import os
import threading
import time

import pytest
from lateness import Lateness
from manual_clock import ManualClock

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication
from fog_contracts.messages import RobotRelease
from fog_runtime.health import Health
from fog_runtime.leadership import Leadership
from fog_runtime.lease_store import LeaseStore
from fog_supervisor.servers import start_redis
from planner.core import PlannerCore
from planner.service import Service

pytestmark = pytest.mark.live
TAKEOVER_S = 2.0
SLACK_S = 0.5
"""How much later everything may come; on a busy machine, as much more as it let the processes wait."""


class Copy:
    """A planner's service and its lease in a real Redis, with neither missions nor a router; it is also its session."""

    connected = True

    def __init__(self, leases: LeaseStore) -> None:
        self.health = Health()
        self.published: list[object] = []
        self.leadership = Leadership("planner", leases, self, self.health, connected=lambda: True)
        self.service = Service(PlannerCore(epoch=1), None, self, ManualClock(), self.health, self.leadership)
        self.epoch = 0

    async def lead(self, epoch: int, *, confirmed: bool) -> None:
        assert confirmed
        self.epoch = epoch

    def stand_by(self) -> None:
        """Keep the epoch, as the core does."""

    def publish(self, channel: ch.Channel, message: object, **_ids: str) -> None:
        if channel is not ch.LEADER:
            self.published.append(message)

    def plan(self) -> None:
        """Publish as the core's thread does."""
        release = RobotRelease(plan_id="1", released_length=1.0, map_epoch=1, map_seq=1, planner_epoch=self.epoch)
        self.service._publish([Publication(ch.ROBOT_RELEASE, release, {"robot": "r1"})])

    @property
    def lease(self) -> str:
        return str(self.health.report()["parts"]["lease"]["detail"])

    def run(self) -> asyncio.Task[None]:
        return asyncio.create_task(self.leadership.run(self, {"planning": self.service.core_answers}))


@pytest.fixture
async def leases(tmp_path):
    with start_redis(tmp_path) as redis:
        async with LeaseStore(redis.url, "test", "planner") as store:
            yield store


async def test_core_that_searches_for_one_robot_after_the_other_answers_between_them(leases, until):
    copy = Copy(leases)
    first, second = threading.Event(), threading.Event()
    searching = threading.Event()

    def plan(_at):
        searching.set()
        first.wait(60.0)
        yield "r1"
        second.wait(60.0)
        yield "r2"

    copy.service._core.plan = plan
    cycle, now = copy.service._cycle, copy.service._edges.now
    planning = asyncio.ensure_future(copy.service._threads.run("core", lambda: cycle.run(now, copy.service._publish)))
    try:
        await until(searching.is_set, "it searches")
        answer = asyncio.ensure_future(copy.service.core_answers())
        await asyncio.wait((answer,), timeout=0.3)
        assert not answer.done(), "nothing was found since it was asked"
        first.set()
        async with asyncio.timeout(60):
            assert await answer
        assert not planning.done()
    finally:
        first.set()
        second.set()
        await planning
        copy.service.close()


async def test_hanging_core_costs_the_lease_and_says_nothing_when_it_goes_on(leases, until):
    hanging, other = Copy(leases), Copy(leases)
    end = threading.Event()
    tasks = [hanging.run()]
    try:
        await until(lambda: hanging.epoch, "the first leads")
        tasks.append(other.run())
        await until(lambda: other.lease.startswith("this process stands by: planner-"), "the second stands by")
        hanging.plan()
        assert len(hanging.published) == 1
        tasks.append(asyncio.ensure_future(hanging.service._threads.run("core", end.wait)))
        hung, late = time.monotonic(), Lateness(lambda: [os.getpid()])
        await until(lambda: other.epoch > hanging.epoch, "the second leads")
        assert time.monotonic() - hung <= TAKEOVER_S + SLACK_S + late.seconds()
        assert hanging.leadership.standby_reason(), "it has given the lease back"
        assert "no answer of planning" in hanging.lease
        hanging.plan()
        assert len(hanging.published) == 1, "a core that goes on says nothing more"
        other.plan()
        assert len(other.published) == 1
    finally:
        end.set()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        hanging.service.close()
        other.service.close()
