import pytest

from fog_contracts import channels as ch
from fog_contracts.bus import Bus, roundtrip
from fog_contracts.codec import ContractError
from fog_contracts.handlers import Moment, Publication, RefusedMessageError
from fog_contracts.messages import CommandReply, MapHeartbeat, PlanReply, RobotCommand, RobotGoal, RobotPose, ZoneSet

AT = Moment(1.0, 1_700_000_001.0)


def heartbeat(seq=1):
    return MapHeartbeat(epoch=1, seq=seq, hash=0, sent=(0, 1.0))


def pose(x=0.0):
    return RobotPose(x=x, y=0.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.1, stamp=1.0)


def replying(reply):
    def answer(_ids, _request, _at):
        return reply

    return answer


class Subscriber:
    """A handler that records each message in `received` and returns `publications`."""

    def __init__(self, name, received, publications=()):
        self.name = name
        self.received = received
        self.publications = publications

    def __call__(self, ids, message, at):
        self.received.append((self.name, dict(ids), message, at))
        return self.publications


@pytest.fixture
def bus():
    return Bus("lab")


def test_messages_are_delivered_as_equal_copies_with_ids_and_moment(bus):
    received, sent = [], pose()
    bus.subscribe({ch.ROBOT_POSE: Subscriber("a", received)})
    bus.publish([Publication(ch.ROBOT_POSE, sent, {"robot": "r1"})])
    assert received == []
    assert bus.deliver(AT) == 1
    ((_, ids, message, at),) = received
    assert (ids, message, at) == ({"robot": "r1"}, sent, AT)
    assert message is not sent
    assert bus.deliver(AT) == 0


def test_messages_published_by_handlers_are_delivered_after_those_queued_before(bus):
    received = []
    bus.subscribe(
        {ch.MAP_HEARTBEAT: Subscriber("map", received, [Publication(ch.ROBOT_POSE, pose(), {"robot": "r1"})])}
    )
    bus.subscribe({ch.MAP_HEARTBEAT: Subscriber("second", received), ch.ROBOT_POSE: Subscriber("pose", received)})
    bus.publish([Publication(ch.MAP_HEARTBEAT, heartbeat(1)), Publication(ch.MAP_HEARTBEAT, heartbeat(2))])
    assert bus.deliver(AT) == 4
    assert [name for name, *_ in received] == ["map", "second", "map", "second", "pose", "pose"]


def test_subscription_is_restricted_to_ids_on_channels_that_have_them(bus):
    received = []
    handlers = {ch.ROBOT_GOAL: Subscriber("goal", received), ch.MAP_HEARTBEAT: Subscriber("map", received)}
    bus.subscribe(handlers, only={"robot": "r1"})
    for robot in ("r2", "r1"):
        bus.publish([Publication(ch.ROBOT_GOAL, RobotGoal(goal_id="g", pose=None, stamp=1.0), {"robot": robot})])
    bus.publish([Publication(ch.MAP_HEARTBEAT, heartbeat())])
    bus.deliver(AT)
    assert [(name, ids) for name, ids, *_ in received] == [("goal", {"robot": "r1"}), ("map", {})]


def test_text_channels_deliver_text(bus):
    received = []
    bus.subscribe({ch.NODE_AVAILABILITY: Subscriber("a", received), ch.THESIS_AREA: Subscriber("b", received)})
    bus.publish([Publication(ch.NODE_AVAILABILITY, "online", {"node": "n1"})])
    bus.publish([Publication(ch.THESIS_AREA, "blocked", {"number": "3"})])
    bus.deliver(AT)
    assert [(ids, message) for _, ids, message, _ in received] == [
        ({"node": "n1"}, "online"),
        ({"number": "3"}, "blocked"),
    ]


@pytest.mark.parametrize(
    ("publication", "error"),
    [
        (Publication(ch.MAP_HEARTBEAT, pose()), ContractError),
        (Publication(ch.MAP_HEARTBEAT, "text"), ContractError),
        (Publication(ch.NODE_AVAILABILITY, "x" * 100, {"node": "n1"}), ContractError),
        (Publication(ch.NODE_AVAILABILITY, heartbeat(), {"node": "n1"}), ContractError),
        (Publication(ch.ROBOT_POSE, pose(), {"robot": "R 1"}), ValueError),
        (Publication(ch.ROBOT_POSE, pose()), ValueError),
    ],
)
def test_message_that_violates_its_channels_contract_is_not_published(bus, publication, error):
    with pytest.raises(error):
        bus.publish([publication])
    assert bus.deliver(AT) == 0


def test_message_refused_by_one_subscriber_reaches_the_others(bus):
    def refuse(ids, message, at):
        raise RefusedMessageError("not like this")

    received = []
    bus.subscribe({ch.NODE_AVAILABILITY: refuse})
    bus.subscribe({ch.NODE_AVAILABILITY: Subscriber("a", received)})
    bus.publish([Publication(ch.NODE_AVAILABILITY, "perhaps", {"node": "n1"})])
    bus.deliver(AT)
    assert bus.refused == ["fog/v1/lab/nodes/n1/availability: not like this"]
    assert len(received) == 1


def test_error_of_a_handler_propagates(bus):
    def fail(ids, message, at):
        raise KeyError("bug")

    bus.subscribe({ch.MAP_HEARTBEAT: fail})
    bus.publish([Publication(ch.MAP_HEARTBEAT, heartbeat())])
    with pytest.raises(KeyError):
        bus.deliver(AT)


def test_query_reaches_the_handler_of_its_ids_only(bus):
    command = RobotCommand(kind="disable", robot="r2", operator="eve", nonce="n" * 16, issued_at=1.0)
    for robot in ("r1", "r2"):
        reply = CommandReply(accepted=True, reason=robot)
        bus.serve({ch.ROBOT_COMMAND: replying(reply)}, only={"robot": robot})
    reply = bus.query(ch.ROBOT_COMMAND, command, CommandReply, AT, robot="r2")
    assert reply == CommandReply(accepted=True, reason="r2")
    assert bus.query(ch.ROBOT_COMMAND, command, CommandReply, AT, robot="r3") is None


def test_published_channel_can_be_queried_for_its_latest_message(bus):
    zones = ZoneSet(epoch=1, seq=2, zones=[], active=[])
    bus.serve({ch.ZONES: replying(zones)})
    assert bus.query(ch.ZONES, None, ZoneSet, AT) == zones
    with pytest.raises(ContractError, match="ZoneSet"):
        bus.query(ch.ZONES, None, PlanReply, AT)


def test_roundtrip_enforces_the_size_limit():
    command = RobotCommand(kind="disable", robot="r1", operator="e" * 9000, nonce="n" * 16, issued_at=1.0)
    with pytest.raises(ContractError, match="limit"):
        roundtrip(ch.ROBOT_COMMAND, command)
