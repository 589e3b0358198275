"""What stands between the core and the world: messages are dated when they arrive, urgent ones wake the core."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import pytest
from ring_map import Map, pose

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication, RefusedMessageError
from fog_contracts.messages import RobotGoal
from fog_runtime.clock import ManualClock
from fog_runtime.health import Health
from planner.core import PlannerCore
from planner.service import Service

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from fog_contracts.handlers import Handler, Ids, Moment


class Session:
    """Keeps what was subscribed to and served."""

    def __init__(self) -> None:
        self.subscribed: dict[ch.Channel, Callable[[dict[str, str], Any], None]] = {}
        self.served: set[ch.Channel] = set()
        self.refused: list[tuple[ch.Channel, str, str]] = []

    def subscribe(self, channel: ch.Channel, _kind: type, handler: Callable[..., None], **_ids: str) -> None:
        self.subscribed[channel] = handler

    def serve(self, channel: ch.Channel, _handler: object, **_ids: str) -> None:
        self.served.add(channel)

    def refuse(self, channel: ch.Channel, key: str, reason: str) -> None:
        self.refused.append((channel, key, reason))


class RecordingCore(PlannerCore):
    """Writes down when each message arrived."""

    def __init__(self) -> None:
        super().__init__(epoch=1)
        self.handled: list[tuple[ch.Channel, Moment]] = []

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        def recording(channel: ch.Channel, handler: Handler) -> Handler:
            def handle(ids: Ids, message: Any, at: Moment) -> list[Publication]:
                self.handled.append((channel, at))
                return list(handler(ids, message, at))

            return handle

        return {channel: recording(channel, handler) for channel, handler in super().handlers().items()}


class Rig:
    def __init__(self, core: PlannerCore) -> None:
        self.core, self.clock, self.session = core, ManualClock(10.0), Session()
        self.service = Service(self.core, cast("Any", None), cast("Any", self.session), self.clock, Health())
        self.service.subscribe()


@pytest.fixture
def rig() -> Rig:
    return Rig(RecordingCore())


def test_every_channel_of_the_core_is_subscribed_to_and_every_query_served(rig: Rig) -> None:
    assert rig.session.subscribed.keys() == rig.core.handlers().keys()
    assert rig.session.served == rig.core.query_handlers().keys()


def test_messages_are_dated_when_they_arrive_however_late_the_core_gets_round_to_them(rig: Rig) -> None:
    rig.session.subscribed[ch.MAP_HEARTBEAT]({}, Map().master.heartbeat(0.0))
    rig.clock.advance(1.0)
    rig.session.subscribed[ch.ROBOT_POSE]({"robot": "r1"}, pose(1.0, 7.0))
    assert rig.core.handled == []
    rig.clock.advance(8.0)
    rig.service._turn()
    assert [(channel.name, at.now) for channel, at in rig.core.handled] == [
        (ch.MAP_HEARTBEAT.name, 10.0),
        (ch.ROBOT_POSE.name, 11.0),
    ]
    rig.service._turn()
    assert len(rig.core.handled) == 2


def test_only_urgent_messages_wake_the_core(rig: Rig) -> None:
    the_map = Map()
    rig.session.subscribed[ch.MAP_HEARTBEAT]({}, the_map.master.heartbeat(0.0))
    assert not rig.service._wake.is_set()
    for delta in the_map.put("z1", (9.0, 10.0, 11.0, 12.0)):
        rig.session.subscribed[ch.MAP_DELTA]({}, delta)
    assert rig.service._wake.is_set()


class ReplyingCore(PlannerCore):
    """Answers a pose with a goal, and refuses another robot's."""

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        def answer(ids: Ids, _pose: Any, _at: Moment) -> list[Publication]:
            if ids["robot"] != "r1":
                raise RefusedMessageError("nobody knows it")
            return [Publication(ch.ROBOT_GOAL, RobotGoal(goal_id="g", pose=None), ids)]

        return {ch.ROBOT_POSE: answer}


def test_what_handlers_return_is_published_by_the_turn_that_runs_them() -> None:
    rig = Rig(ReplyingCore(epoch=1))
    rig.session.subscribed[ch.ROBOT_POSE]({"robot": "r1"}, pose(1.0, 7.0))
    assert [(p.channel.name, p.ids) for p in rig.service._turn().publications] == [("robot_goal", {"robot": "r1"})]
    assert rig.service._turn().publications == []


def test_what_a_handler_refuses_is_reported_and_the_turn_goes_on() -> None:
    rig = Rig(ReplyingCore(epoch=1))
    for robot in ("r2", "r1"):
        rig.session.subscribed[ch.ROBOT_POSE]({"robot": robot}, pose(1.0, 7.0))
    assert [p.ids for p in rig.service._turn().publications] == [{"robot": "r1"}]
    assert rig.session.refused == [(ch.ROBOT_POSE, "fog/*/robots/r2/pose", "nobody knows it")]
