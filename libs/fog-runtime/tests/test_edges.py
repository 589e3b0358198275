"""A table of handlers wired to transports that only record calls."""

import pytest
from manual_clock import ManualClock

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_contracts.codec import encode
from fog_contracts.handlers import Moment, Publication
from fog_runtime import metrics
from fog_runtime.transports.edges import Edges

POSE = m.RobotPose(x=1.0, y=2.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.2, height=0.3, stamp=1.0)
GOAL = m.RobotGoal(goal_id="g", pose=None)


class Mqtt:
    def __init__(self) -> None:
        self.handlers, self.numbers, self.sent = {}, {}, []

    def on(self, channel, handler, kind=None, *, numbers=()):
        assert kind is channel.message
        self.handlers[channel], self.numbers[channel] = handler, list(numbers)

    def publish_nowait(self, channel, message, **ids):
        self.sent.append((channel, message, ids))


class Zenoh:
    def __init__(self) -> None:
        self.handlers, self.only, self.served, self.sent = {}, {}, {}, []
        self.polled = {}

    def subscribe(self, channel, kind, handler, **ids):
        assert kind is channel.message
        self.handlers[channel], self.only[channel] = handler, ids

    def subscribe_polled(self, channel, kind, handler, **ids):
        assert kind is channel.message
        self.polled[channel], self.only[channel] = handler, ids

    def serve(self, channel, handler, **ids):
        self.served.setdefault(channel, []).append((handler, ids))

    def publish(self, channel, message, **ids):
        self.sent.append((channel, message, ids))


def test_each_channel_is_subscribed_on_its_transport_and_results_are_published():
    clock, mqtt, zenoh = ManualClock(5.0), Mqtt(), Zenoh()
    edges = Edges(clock, mqtt=mqtt, zenoh=zenoh)
    received, published = [], []

    def handler(ids, message, at):
        received.append((dict(ids), message, at))
        return [Publication(ch.ROBOT_GOAL, GOAL, {"robot": "r1"}), Publication(ch.THESIS_WSN, "7,1,2")]

    def publish(publications):
        published.extend(publications)
        for publication in publications:
            edges.publish(publication)

    edges.subscribe({ch.ROBOT_POSE: handler, ch.THESIS_AREA: handler}, publish, numbers=[7])
    zenoh.handlers[ch.ROBOT_POSE]({"robot": "r1"}, POSE)
    clock.advance(1.0)
    mqtt.handlers[ch.THESIS_AREA]({"number": "7"}, "blocked")
    assert received == [
        ({"robot": "r1"}, POSE, Moment(5.0, 5.0)),
        ({"number": "7"}, "blocked", Moment(6.0, 6.0)),
    ]
    assert len(published) == 4
    assert zenoh.sent == [(ch.ROBOT_GOAL, GOAL, {"robot": "r1"})] * 2
    assert mqtt.sent == [(ch.THESIS_WSN, "7,1,2", {})] * 2
    assert mqtt.numbers[ch.THESIS_AREA] == [7]


def test_polled_channels_are_only_those_that_are_named():
    clock, zenoh, received = ManualClock(5.0), Zenoh(), []
    edges = Edges(clock, zenoh=zenoh)

    def handler(ids, message, at):
        received.append((dict(ids), message, at))
        return ()

    handlers = {ch.ROBOT_POSE: handler, ch.ROBOT_GOAL: handler}
    edges.subscribe(handlers, lambda _: None, only={"robot": "r1"}, polled=[ch.ROBOT_POSE])
    assert (zenoh.polled.keys(), zenoh.handlers.keys()) == ({ch.ROBOT_POSE}, {ch.ROBOT_GOAL})
    assert zenoh.only[ch.ROBOT_POSE] == {"robot": "r1"}
    zenoh.polled[ch.ROBOT_POSE]({"robot": "r1"}, POSE)
    assert received == [({"robot": "r1"}, POSE, Moment(5.0, 5.0))]


def test_channel_without_a_connected_transport_raises():
    edges = Edges(ManualClock(), zenoh=Zenoh())
    with pytest.raises(ValueError, match="node_reading"):
        edges.subscribe({ch.NODE_READING: lambda _ids, _message, _at: []}, list)
    with pytest.raises(ValueError, match="thesis_wsn"):
        edges.publish(Publication(ch.THESIS_WSN, "7,1,2"))
    with pytest.raises(ValueError, match="robot_goal"):
        Edges(ManualClock(), mqtt=Mqtt()).publish(Publication(ch.ROBOT_GOAL, GOAL, {"robot": "r1"}))


def test_robot_subscribes_and_serves_only_its_own_keys():
    clock, zenoh = ManualClock(5.0), Zenoh()
    edges = Edges(clock, zenoh=zenoh)

    def ignore(_ids, _message, _at):
        return []

    def answer(ids, command, at):
        return m.CommandReply(accepted=True, reason=f"{ids['robot']} {command.kind} {at.now}")

    edges.subscribe({ch.ROBOT_GOAL: ignore, ch.MAP_HEARTBEAT: ignore}, list, only={"robot": "r1"})
    assert zenoh.only == {ch.ROBOT_GOAL: {"robot": "r1"}, ch.MAP_HEARTBEAT: {}}
    replies = []
    edges.serve({ch.ROBOT_COMMAND: answer}, only={"robot": "r1"}, on_reply=lambda *reply: replies.append(reply))
    ((handler, ids),) = zenoh.served[ch.ROBOT_COMMAND]
    assert ids == {"robot": "r1"}
    command = m.RobotCommand(kind="cancel", robot="r1", operator="ann", nonce="n" * 16, issued_at=1.0)
    reply = handler({"robot": "r1"}, command)
    assert reply.reason == "r1 cancel 5.0"
    assert replies == [(ch.ROBOT_COMMAND, command, reply)]
    with pytest.raises(ValueError, match="robot_command"):
        Edges(clock, mqtt=Mqtt()).serve({ch.ROBOT_COMMAND: answer}, only={"robot": "r1"})
    with pytest.raises(ValueError, match=r"robot_command.*robot"):
        edges.serve({ch.ROBOT_COMMAND: answer})


def test_published_channel_is_served_under_each_key_from_its_first_publication():
    zenoh = Zenoh()
    edges = Edges(ManualClock(), zenoh=zenoh)
    edges.serve({ch.ROBOT_GOAL: lambda _ids, _request, _at: GOAL})
    assert zenoh.served == {}
    for robot in ("r1", "r2", "r1"):
        edges.publish(Publication(ch.ROBOT_GOAL, GOAL, {"robot": robot}))
    assert [ids for _, ids in zenoh.served[ch.ROBOT_GOAL]] == [{"robot": "r1"}, {"robot": "r2"}]
    handler, ids = zenoh.served[ch.ROBOT_GOAL][0]
    assert handler(ids, None) == GOAL


def test_message_that_violates_its_channel_is_counted_and_does_not_end_the_caller():
    class StrictZenoh(Zenoh):
        def publish(self, channel, message, **ids):
            encode(channel, message)
            super().publish(channel, message, **ids)

    zenoh = StrictZenoh()
    edges = Edges(ManualClock(5.0), zenoh=zenoh)
    before = metrics.UNPUBLISHABLE.labels("robot_goal")._value.get()
    edges.publish(Publication(ch.ROBOT_GOAL, m.RobotGoal(goal_id="g" * 2000, pose=None), {"robot": "r1"}))
    edges.publish(Publication(ch.ROBOT_GOAL, GOAL, {"robot": "r1"}))
    assert [message for _, message, _ in zenoh.sent] == [GOAL]
    assert metrics.UNPUBLISHABLE.labels("robot_goal")._value.get() == before + 1
