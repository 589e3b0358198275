import pytest

from fog_contracts import channels as ch
from fog_contracts.bus import Bus, roundtrip
from fog_contracts.codec import ContractError
from fog_contracts.handlers import Moment, Publication, RefusedMessageError
from fog_contracts.messages import CommandReply, MapHeartbeat, PlanReply, RobotCommand, RobotGoal, RobotPose, ZoneSet

AT = Moment(1.0, 1_700_000_001.0)


def heartbeat(seq=1):
    return MapHeartbeat(epoch=1, seq=seq, hash=0, stamp=1.0)


def pose(x=0.0):
    return RobotPose(x=x, y=0.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.1, stamp=1.0)


def always(reply):
    def answer(_ids, _request, _at):
        return reply

    return answer


class Heard:
    """A subscriber that notes what it gets, and publishes `answers` in return."""

    def __init__(self, name, notes, answers=()):
        self.name = name
        self.notes = notes
        self.answers = answers

    def __call__(self, ids, message, at):
        self.notes.append((self.name, dict(ids), message, at))
        return self.answers


@pytest.fixture
def bus():
    return Bus("lab")


def test_messages_arrive_as_equal_copies_with_their_ids_and_the_moment_of_delivery(bus):
    notes, sent = [], pose()
    bus.subscribe({ch.ROBOT_POSE: Heard("a", notes)})
    bus.publish([Publication(ch.ROBOT_POSE, sent, {"robot": "r1"})])
    assert notes == []
    assert bus.deliver(AT) == 1
    ((_, ids, got, at),) = notes
    assert (ids, got, at) == ({"robot": "r1"}, sent, AT)
    assert got is not sent
    assert bus.deliver(AT) == 0


def test_what_is_published_in_return_is_delivered_after_what_was_on_its_way_before(bus):
    notes = []
    bus.subscribe({ch.MAP_HEARTBEAT: Heard("map", notes, [Publication(ch.ROBOT_POSE, pose(), {"robot": "r1"})])})
    bus.subscribe({ch.MAP_HEARTBEAT: Heard("second", notes), ch.ROBOT_POSE: Heard("pose", notes)})
    bus.publish([Publication(ch.MAP_HEARTBEAT, heartbeat(1)), Publication(ch.MAP_HEARTBEAT, heartbeat(2))])
    assert bus.deliver(AT) == 4
    assert [name for name, *_ in notes] == ["map", "second", "map", "second", "pose", "pose"]


def test_a_subscription_can_be_narrowed_to_ids_and_channels_without_these_ids_stay_wide(bus):
    notes = []
    handlers = {ch.ROBOT_GOAL: Heard("goal", notes), ch.MAP_HEARTBEAT: Heard("map", notes)}
    bus.subscribe(handlers, only={"robot": "r1"})
    for robot in ("r2", "r1"):
        bus.publish([Publication(ch.ROBOT_GOAL, RobotGoal(goal_id="g", pose=None, stamp=1.0), {"robot": robot})])
    bus.publish([Publication(ch.MAP_HEARTBEAT, heartbeat())])
    bus.deliver(AT)
    assert [(name, ids) for name, ids, *_ in notes] == [("goal", {"robot": "r1"}), ("map", {})]


def test_text_channels_carry_text(bus):
    notes = []
    bus.subscribe({ch.NODE_AVAILABILITY: Heard("a", notes), ch.THESIS_AREA: Heard("b", notes)})
    bus.publish([Publication(ch.NODE_AVAILABILITY, "online", {"node": "n1"})])
    bus.publish([Publication(ch.THESIS_AREA, "blocked", {"number": "3"})])
    bus.deliver(AT)
    assert [(ids, message) for _, ids, message, _ in notes] == [
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
def test_a_message_that_breaks_its_channels_contract_is_not_published(bus, publication, error):
    with pytest.raises(error):
        bus.publish([publication])
    assert bus.deliver(AT) == 0


def test_what_a_subscriber_refuses_is_noted_and_others_still_get_it(bus):
    def refuse(ids, message, at):
        raise RefusedMessageError("not like this")

    notes = []
    bus.subscribe({ch.NODE_AVAILABILITY: refuse})
    bus.subscribe({ch.NODE_AVAILABILITY: Heard("a", notes)})
    bus.publish([Publication(ch.NODE_AVAILABILITY, "perhaps", {"node": "n1"})])
    bus.deliver(AT)
    assert bus.refused == ["fog/v1/lab/nodes/n1/availability: not like this"]
    assert len(notes) == 1


def test_an_error_of_a_subscriber_is_not_hidden(bus):
    def fail(ids, message, at):
        raise KeyError("bug")

    bus.subscribe({ch.MAP_HEARTBEAT: fail})
    bus.publish([Publication(ch.MAP_HEARTBEAT, heartbeat())])
    with pytest.raises(KeyError):
        bus.deliver(AT)


def test_queries_reach_who_serves_these_ids_and_nobody_else(bus):
    command = RobotCommand(kind="disable", robot="r2", operator="eve", nonce="n" * 16, issued_at=1.0)
    for robot in ("r1", "r2"):
        reply = CommandReply(accepted=True, reason=robot)
        bus.serve({ch.ROBOT_COMMAND: always(reply)}, only={"robot": robot})
    reply = bus.query(ch.ROBOT_COMMAND, command, CommandReply, AT, robot="r2")
    assert reply == CommandReply(accepted=True, reason="r2")
    assert bus.query(ch.ROBOT_COMMAND, command, CommandReply, AT, robot="r3") is None


def test_a_published_channel_can_be_asked_for_its_latest_message(bus):
    zones = ZoneSet(epoch=1, seq=2, zones=[])
    bus.serve({ch.ZONES: always(zones)})
    assert bus.query(ch.ZONES, None, ZoneSet, AT) == zones
    with pytest.raises(ContractError, match="ZoneSet"):
        bus.query(ch.ZONES, None, PlanReply, AT)


def test_a_roundtrip_enforces_the_limit():
    command = RobotCommand(kind="disable", robot="r1", operator="e" * 2000, nonce="n" * 16, issued_at=1.0)
    with pytest.raises(ContractError, match="limit"):
        roundtrip(ch.ROBOT_COMMAND, command)
