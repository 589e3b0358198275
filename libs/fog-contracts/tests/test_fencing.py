"""Receivers refuse what a replaced leader sends, on every channel that carries an epoch."""

import pytest

from fog_contracts import channels as ch
from fog_contracts.handlers import HEARD_LIMIT, MOST_AHEAD, Fence, Moment, RefusedMessageError, epoch_in
from fog_contracts.messages import Leader, MapHeartbeat, RobotGoal, ZoneSet

AT = Moment(1.0, 2.0)
LED = {ch.AGGREGATOR, ch.MAP, ch.PLANNER}
WITHOUT_EPOCH = {
    "leader",  # the announcement itself
    "lift_request",  # the lift itself is the lock: it serves one session, which is one ride of one robot
    "node_config",  # constant, from the site's files
    "zone_request",  # of others; the map-service only deletes what the broker retains of it
}


def goal(epoch: int) -> RobotGoal:
    return RobotGoal(goal_id="g", pose=None, planner_epoch=epoch)


def test_every_message_that_a_leader_publishes_carries_its_epoch():
    led = [row for row in ch.CHANNELS.values() if row.kind == "pub" and LED & {*row.publishers}]
    without = {row.name for row in led if row.message is not None and not row.epoch}
    assert without == WITHOUT_EPOCH
    for row in led:
        if row.epoch:
            assert row.message is not None
            assert row.epoch in row.message.__struct_fields__, row.name
            assert len(row.publishers) == 1


def test_message_of_a_lower_epoch_is_refused_on_all_channels_of_its_sender():
    fence, handled = Fence(), []
    handlers = fence.guarded(
        {channel: lambda _, message, __: handled.append(message) or () for channel in (ch.MAP_HEARTBEAT, ch.ZONES)}
    )
    heartbeat = MapHeartbeat(epoch=5, seq=1, hash=0, sent=(0, 0.0))
    handlers[ch.MAP_HEARTBEAT]({}, heartbeat, AT)
    with pytest.raises(RefusedMessageError, match="its epoch 4 is below 5: another map-service has taken over"):
        handlers[ch.ZONES]({}, ZoneSet(epoch=4, seq=9, zones=[], active=[]), AT)
    handlers[ch.MAP_HEARTBEAT]({}, heartbeat, AT)
    assert handled == [heartbeat, heartbeat]
    assert fence.epochs == {"map-service": 5}


def test_epochs_of_different_services_are_independent():
    fence = Fence()
    handlers = fence.guarded({ch.MAP_HEARTBEAT: lambda *_: (), ch.ROBOT_GOAL: lambda *_: ()})
    handlers[ch.MAP_HEARTBEAT]({}, MapHeartbeat(epoch=9, seq=1, hash=0, sent=(0, 0.0)), AT)
    handlers[ch.ROBOT_GOAL]({}, goal(2), AT)
    fence.raise_to("planner", 3)
    with pytest.raises(RefusedMessageError):
        handlers[ch.ROBOT_GOAL]({}, goal(2), AT)


def test_epochs_are_heard_from_the_service_itself_and_from_those_that_received_them():
    assert epoch_in(ch.ROBOT_GOAL, goal(7), "planner") == 7
    assert epoch_in(ch.ROBOT_GOAL, goal(7), "map-service") == 0
    leader = Leader(epoch=3, holder="p", epochs={"map-service": 8})
    assert epoch_in(ch.LEADER, leader, "map-service") == 8
    assert epoch_in(ch.LEADER, leader, "planner") == 0


def test_message_with_an_epoch_that_no_service_can_have_is_refused_and_leaves_room_above_it():
    fence, handled = Fence(), []
    handlers = fence.guarded({ch.MAP_HEARTBEAT: lambda _, message, __: handled.append(message) or ()})
    handlers[ch.MAP_HEARTBEAT]({}, MapHeartbeat(epoch=5, seq=1, hash=0, sent=(0, 0.0)), AT)
    with pytest.raises(RefusedMessageError, match="no map-service can have it"):
        handlers[ch.MAP_HEARTBEAT]({}, MapHeartbeat(epoch=2**53, seq=1, hash=0, sent=(0, 0.0)), AT)
    following = fence.epochs[ch.MAP] + 1
    assert following < HEARD_LIMIT + 2**32
    handlers[ch.MAP_HEARTBEAT]({}, MapHeartbeat(epoch=following, seq=1, hash=0, sent=(0, 0.0)), AT)
    assert [message.epoch for message in handled] == [5, following]


def test_receiver_that_starts_late_gets_up_to_a_leader_that_had_to_follow_forged_epochs():
    fence = Fence()
    epoch = HEARD_LIMIT + 3 * MOST_AHEAD
    for _ in range(2):
        with pytest.raises(RefusedMessageError):
            fence.accept("planner", epoch)
    fence.accept("planner", epoch)
    assert fence.epochs == {"planner": epoch}


def test_epoch_that_came_another_way_raises_no_further_than_a_message():
    fence = Fence()
    assert not fence.reaches("planner", 2**53)
    fence.raise_to("planner", 2**53)
    assert fence.epochs == {"planner": HEARD_LIMIT + MOST_AHEAD}
