"""The agent's core in a closed loop with a little world: driving, and above all stopping."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from little_world import DT, KEY, L_PATH, START, LittleWorld, release_of, trace

from fog_contracts import channels as ch
from fog_contracts.commands import sign
from fog_contracts.handlers import Moment, RefusedMessageError
from fog_contracts.messages import (
    AreaHazard,
    Cause,
    HazardArea,
    PolygonShape,
    Pose,
    Refusal,
    RobotCommand,
    RobotObstacles,
    RobotPath,
    RobotPose,
    RobotState,
    Zone,
    ZoneSet,
)
from fog_contracts.replica import MapError, MasterMap
from fog_kernels.inflation import inflate
from robot_agent.agent.core import AgentCore
from robot_agent.agent.hand_driving import TakeOver
from robot_agent.hardware import ON_CHARGER
from robot_agent.localization.pose import SavedPose
from robot_agent.motion.local_planner import decide
from robot_agent.scan_builder import Mounting


@pytest.fixture
def world():
    return LittleWorld().ready()


@pytest.fixture
def driving(world):
    world.drive_to(L_PATH)
    world.run(5.0)
    assert world.state().mode == "NORMAL"
    assert sum(world.wheels) / 2 == pytest.approx(0.3, abs=0.02)
    return world


def seconds_to_rest(world, limit=3.0):
    begin = world.now
    assert world.run(limit, lambda w: w.wheels == (0.0, 0.0)), f"the wheels still turn after {limit} s"
    return world.now - begin


def test_robot_drives_along_the_corridors_and_reports_the_goal_as_reached(world):
    world.drive_to(L_PATH, theta=math.pi)
    assert world.run(100, lambda w: w.state().goal_reached)
    assert math.hypot(world.x - 12.0, world.y - 10.0) < 0.15
    assert abs(math.remainder(world.theta - math.pi, 2 * math.pi)) < 0.25
    assert not world.collided
    assert world.worst_error[0] < 0.10
    assert world.worst_error[1] < 0.06
    assert world.travelled < 19.5
    assert world.state().goal_id == "g1"
    world.run(1.0)
    assert world.wheels == (0.0, 0.0)
    assert world.state().goal_id is None, "the planner has ended it"
    speeds = np.array(world.commands)[:, 1:]
    assert np.abs(speeds).max() <= 0.5
    assert np.abs(speeds.mean(axis=1)).max() <= 0.3 + 1e-9


def test_same_seed_gives_the_same_drive_to_the_last_bit():
    drives = []
    for _ in range(2):
        world = LittleWorld(seed=5).ready()
        world.drive_to(L_PATH)
        world.run(15.0)
        drives.append(world.commands)
    assert drives[0] == drives[1]


def test_a_path_that_starts_behind_the_robot_is_begun_by_turning_on_the_spot():
    world = LittleWorld(pose=(6.0, 2.0, math.pi)).ready()
    world.drive_to([(6.0, 2.0), (9.0, 2.0)])
    world.run(2.0)
    assert math.hypot(world.x - 6.0, world.y - 2.0) < 0.2
    assert world.run(30.0, lambda w: w.state().goal_reached)


def test_robot_stops_at_the_released_end_and_continues_when_more_is_released(world):
    world.drive_to(L_PATH, released=2.0)
    world.run(20.0)
    assert 3.7 < world.x < 4.05
    assert world.wheels == (0.0, 0.0)
    assert not world.state().goal_reached
    world.path = msgspec.structs.replace(world.path, released_length=4.0)
    world.run(15.0)
    assert 5.7 < world.x < 6.05


@pytest.mark.parametrize("box", [(6.0, 1.5, 6.29, 1.94), (6.0, 1.8, 6.29, 2.3)])
def test_obstacle_beside_or_on_the_path_that_only_the_lidar_sees_is_avoided(world, box):
    window = world.geometry.window_around(*box)
    world.solid[window.rows, window.columns] = 1
    world.drive_to(L_PATH)
    # It may hesitate between the two sides: of 30 seeds, 4 needed 31 to 55 s.
    assert world.run(60, lambda w: w.x > 7.5), world.state().reasons
    assert not world.collided
    assert abs(world.y - 2.0) < 0.15


def test_wall_across_the_corridor_stops_the_robot_without_contact(world):
    g = world.geometry
    window = g.window_around(6.0, 1.0, 6.2, 3.0)
    world.solid[window.rows, window.columns] = 1
    world.drive_to(L_PATH)
    held = world.run(90.0, lambda w: any("no progress" in reason or "near" in reason for reason in w.state().reasons))
    assert held, world.state().reasons
    assert not world.collided
    assert not world.state().goal_reached
    assert world.wheels[0] + world.wheels[1] == pytest.approx(0.0, abs=0.05)


def test_a_lethal_change_on_the_path_nearby_holds_it_until_a_new_plan(driving):
    ahead = driving.x + 1.5
    driving.block(ahead, 1.0, ahead + 0.5, 3.0)
    assert seconds_to_rest(driving) <= 0.6
    driving.run(1.0)
    state = driving.state()
    assert state.mode == "HOLD"
    assert any("the path is blocked" in reason for reason in state.reasons)
    assert driving.x < ahead - 0.8
    back = [(driving.x, driving.y), (3.5, 2.0), (3.5, 3.8)]
    driving.drive_to(back, plan_id=2)
    assert driving.run(40.0, lambda w: w.state().goal_reached)
    assert not driving.collided


def test_a_lethal_change_far_ahead_leaves_the_planner_a_second(driving):
    driving.block(12.0, 6.0, 12.5, 6.5)
    driving.block(11.0, 6.5, 13.0, 7.0)
    driving.run(0.8)
    assert driving.state().mode == "NORMAL"
    driving.run(0.5)
    assert driving.state().mode == "HOLD"


def test_a_blocked_goal_is_named_as_such(driving):
    driving.block(11.7, 9.6, 12.3, 10.4)
    driving.run(1.5)
    assert any("goal is blocked" in reason for reason in driving.state().reasons)


def test_refusal_holds_the_robot_with_the_planners_reason(driving):
    sentence = "area Z4 cuts the only way"
    refused = msgspec.structs.replace(
        driving.path, plan_id=2, points=[], refusal=Refusal(code=208, reason=sentence, causes=[])
    )
    driving.path = refused
    driving.send(ch.ROBOT_PATH, refused)
    assert seconds_to_rest(driving) <= 0.6
    assert driving.state().mode == "HOLD"
    assert sentence in " ".join(driving.state().reasons)


def test_heartbeats_that_come_ever_later_at_their_usual_rate_slow_then_hold_the_robot(driving):
    driving.link_delay_growth = 0.5
    driving.run(1.5)
    assert driving.state().mode == "NORMAL"
    driving.run(1.5)
    assert driving.link_delay == pytest.approx(1.5, abs=0.1)
    assert driving.state().mode == "DEGRADED"
    driving.run(4.0)
    assert driving.link_delay == pytest.approx(3.5, abs=0.1)
    assert driving.state().mode == "HOLD"
    driving.run(13.0)
    driving.link_delay_growth = 0.0
    driving.run(20.0)
    assert driving.link_delay == pytest.approx(10.0, abs=0.1)
    assert driving.state().mode == "HOLD"
    assert driving.wheels == (0.0, 0.0)
    driving.link_delay = 0.0
    assert driving.run(5.0, lambda w: w.state().mode == "NORMAL")


def test_path_that_comes_before_its_goal_is_followed_once_that_comes(driving):
    points, goal = driving.path.points, driving.goal
    driving.path_on = False
    driving.drive_to(points, goal_id="g2", plan_id=2)
    # As drive_to, in the other order.
    path = msgspec.structs.replace(driving.path, goal_id="g3", plan_id=3)
    driving.send(ch.ROBOT_PATH, path)
    assert driving.state().plan_id == 2
    driving.send(ch.ROBOT_GOAL, msgspec.structs.replace(goal, goal_id="g3"))
    assert driving.state().plan_id == 3


def test_missing_heartbeats_slow_then_hold_the_robot_until_they_return(driving):
    driving.heartbeats_on = False
    driving.run(1.3)
    assert driving.state().mode == "DEGRADED"
    driving.run(1.0)
    assert sum(driving.wheels) / 2 <= 0.15 + 1e-9
    driving.run(1.0)
    assert driving.state().mode == "HOLD"
    driving.run(0.6)
    assert driving.wheels == (0.0, 0.0)
    stood = driving.x
    driving.heartbeats_on = True
    driving.run(1.5)
    assert driving.state().mode == "HOLD"
    assert driving.run(3.0, lambda w: w.state().mode == "NORMAL")
    driving.run(3.0)
    assert driving.x > stood + 0.3


def test_missed_delta_holds_the_robot_until_a_snapshot_is_loaded(driving):
    driving.block(3.0, 3.9, 3.2, 4.1, publish=False)
    driving.run(0.9)
    assert driving.state().mode == "NORMAL"
    driving.run(0.5)
    assert driving.state().mode == "HOLD"
    driving.agent.load(driving.master.snapshot(), driving.now)
    assert driving.run(4.0, lambda w: w.state().mode == "NORMAL")


def test_snapshot_with_an_epoch_that_no_map_service_can_have_is_refused_and_the_robot_keeps_its_map(driving):
    with pytest.raises(MapError, match="no map-service can have"):
        driving.agent.load(msgspec.structs.replace(driving.master.snapshot(), epoch=2**53), driving.now)
    driving.run(2.0)
    assert driving.state().mode == "NORMAL"


def test_new_map_in_another_frame_stops_a_driving_robot_until_it_is_found_there_and_enabled(driving):
    moved = msgspec.structs.replace(driving.geometry, origin_x=driving.geometry.origin_x + 3.0)
    cost = inflate(driving.raw, driving.table)
    driving.master = MasterMap("lab", moved, driving.static, cost, epoch=8)
    driving.agent.load(driving.master.snapshot(), driving.now)
    assert driving.run(1.0, lambda w: w.state().mode == "PROTECTIVE_STOP")
    assert "pose_unknown" in driving.state().codes
    seconds_to_rest(driving)
    assert driving.run(20.0, lambda w: w.agent.localizer.status == "good")
    pose = driving.agent.localizer.pose(driving.now)
    assert math.hypot(pose.x - driving.x - 3.0, pose.y - driving.y) < 0.1
    driving.run(3.0)
    assert driving.state().mode == "PROTECTIVE_STOP"
    assert driving.command("enable").accepted


def test_late_deltas_do_not_make_the_map_fresh_while_newer_ones_are_missing(driving):
    boxes = [(3.0 + 0.2 * i, 3.9, 3.1 + 0.2 * i, 4.0) for i in range(4)]
    late = [delta for box in boxes for delta in driving.block(*box, publish=False)]
    for delta in late[:-1]:
        driving.run(0.5)
        driving.send(ch.MAP_DELTA, delta)
    assert driving.state().mode == "HOLD"
    assert any("have been missing" in reason for reason in driving.state().reasons)
    driving.send(ch.MAP_DELTA, late[-1])
    assert driving.run(4.0, lambda w: w.state().mode == "NORMAL")


def test_snapshot_older_than_the_heartbeat_version_does_not_make_the_map_fresh(driving):
    old = driving.master.snapshot()
    driving.block(3.0, 3.9, 3.2, 4.1, publish=False)
    driving.run(0.9)
    driving.agent.load(old, driving.now)
    driving.run(0.3)
    assert driving.state().mode == "HOLD"


def test_path_through_a_known_wall_holds_the_robot(world):
    world.drive_to([(2.0, 2.0), (3.5, 3.8)])
    world.run(1.5)
    assert world.path.map_seq == world.state().map_seq
    assert world.state().mode == "HOLD"
    assert any("the path is blocked" in reason for reason in world.state().reasons)


def test_silent_lidar_stops_the_wheels_immediately(driving):
    driving.lidar_on = False
    begin = driving.now
    assert driving.run(1.0, lambda w: w.state().mode == "PROTECTIVE_STOP")
    assert driving.now - begin <= 0.36
    assert driving.wheels == (0.0, 0.0)
    driving.lidar_on = True
    driving.run(1.5)
    assert driving.wheels == (0.0, 0.0)
    assert driving.run(3.0, lambda w: w.state().mode == "NORMAL")


def test_identical_scans_stop_the_wheels(driving):
    driving.frozen_scan = np.column_stack((-(np.arange(360) + 0.5) * math.pi / 180, np.full(360, 3.0)))
    assert driving.run(0.8, lambda w: w.state().mode == "PROTECTIVE_STOP")
    assert any("the lidar repeats itself" in reason for reason in driving.state().reasons)


def test_a_lidar_that_turns_and_sees_nothing_stops_the_wheels_and_open_space_on_one_side_does_not(driving):
    driving.glass = [(-99.0, -99.0, driving.x, 99.0)]
    assert not driving.run(0.8, lambda w: any("sees nothing" in reason for reason in w.state().reasons))
    driving.glass = [(-99.0, -99.0, 99.0, 99.0)]
    assert driving.run(0.8, lambda w: w.state().mode == "PROTECTIVE_STOP")
    assert any("the lidar turns and sees nothing" in reason for reason in driving.state().reasons)
    assert driving.command("disable").accepted
    assert "the lidar turns and sees nothing" in driving.agent.on_hand(TakeOver(), driving.now).reason


def test_a_guardian_that_counts_with_other_wheels_stops_them_with_the_remedy(driving):
    driving.guardian_wrap = driving.config.drive_train.travel_wrap_m
    assert not driving.run(0.5, lambda w: w.state().mode == "PROTECTIVE_STOP")
    driving.guardian_wrap *= 1.05
    assert driving.run(0.5, lambda w: w.state().mode == "PROTECTIVE_STOP")
    assert any("restart fognav-watchdog fognav-agent" in reason for reason in driving.state().reasons)


def test_silent_guardian_stops_the_wheels(driving):
    driving.base_on = False
    driving.run(0.4)
    assert driving.state().mode == "PROTECTIVE_STOP"
    assert driving.commands[-1][1:] == (0.0, 0.0)


def test_a_hung_control_loop_stops_the_robot_within_a_second(driving):
    driving.decide_on = False
    assert seconds_to_rest(driving) <= 0.4 + 0.2 + 0.5 + 0.1


def test_computer_that_was_frozen_while_the_floor_is_free_invents_no_obstacle(driving):
    driving.published.clear()
    before = driving.travelled
    driving.run(0.1)
    driving.wheels = (0.0, 0.0)  # the guardian's doing
    driving.steps += 1200
    job = driving.agent.control_job(START + driving.steps * DT)  # it happens to run before the safety gate does
    assert job.recovery is None
    driving.run(0.2)
    assert not any("no progress" in reason for reason in driving.state().reasons)
    driving.run(9.0)
    assert not any(report.points for report in driving.published_on(ch.ROBOT_OBSTACLES))
    assert driving.travelled > before + 0.5


def test_a_pressed_bumper_is_a_fault_until_an_operator_resets_it(driving):
    driving.bumper = True
    driving.run(0.1)
    assert driving.wheels == (0.0, 0.0)
    assert driving.state().mode == "FAULT"
    assert "bumper" in driving.command("reset").reason
    driving.bumper = False
    driving.run(3.0)
    assert driving.state().mode == "FAULT"
    assert not driving.command("enable").accepted
    assert driving.command("reset").accepted
    driving.run(0.2)
    assert driving.resets == 1
    assert driving.state().mode == "INIT"
    assert driving.command("enable").accepted
    driving.run(2.5)
    assert driving.state().mode == "NORMAL"


def test_a_bumper_pressed_while_the_robot_is_not_enabled_is_a_fault_until_a_reset(world):
    assert world.command("disable").accepted
    assert world.run(5.0, lambda w: w.state().reasons == ["waiting for an operator to enable"])
    world.bumper, world.fault = True, "the bumper is pressed (left)"
    assert world.run(0.5, lambda w: w.state().mode == "FAULT"), "a robot that stands by looks 5 times a second"
    world.bumper = False
    world.run(10.0)
    assert world.state().mode == "FAULT"
    assert "reset it first" in world.command("enable").reason
    assert world.command("reset").accepted
    world.run(5.0)
    assert (world.resets, world.fault, world.state().mode) == (1, None, "INIT")
    assert world.command("enable").accepted


def test_robot_started_with_its_bumper_pressed_finds_its_place_before_it_is_reset():
    world = LittleWorld()
    world.bumper = True
    world.agent.load(world.master.snapshot(), world.now)
    assert world.run(20.0, lambda one: one.agent.localizer.status == "good"), world.state().reasons
    assert world.error()[0] < 0.1
    assert world.state().mode == "FAULT"
    world.bumper = False
    world.run(0.5)
    assert world.command("reset").accepted
    world.run(0.2)
    assert world.command("enable").accepted


def test_robot_that_is_lifted_looks_for_its_place_only_when_it_stands_again():
    world = LittleWorld()
    world.wheel_drop = True
    world.agent.load(world.master.snapshot(), world.now)
    world.run(20.0)
    assert (world.state().mode, world.agent.localizer.status) == ("FAULT", "none")
    world.wheel_drop = False
    assert world.run(20.0, lambda one: one.agent.localizer.status == "good"), world.state().reasons
    assert world.state().mode == "FAULT"


def test_reset_is_passed_on_to_the_guardian_and_clears_its_fault(driving):
    driving.fault = "the base left Safe mode by itself (now PASSIVE)"
    driving.run(0.1)
    assert driving.state().mode == "FAULT"
    assert driving.command("reset").accepted
    driving.run(0.3)
    assert driving.fault is None
    assert driving.command("enable").accepted


def test_restarted_agent_localizes_and_waits_for_an_enable(driving):
    assert driving.restart() is not None
    driving.agent.load(driving.master.snapshot(), driving.now)
    driving.run(2.0)
    assert driving.wheels == (0.0, 0.0)
    assert driving.error()[0] < 0.1
    state = driving.state()
    assert state.mode == "INIT"
    assert state.reasons == ["waiting for an operator to enable"]
    assert driving.command("enable").accepted
    assert driving.run(80, lambda w: w.state().goal_reached)


def test_restarted_agent_that_was_carried_away_does_not_trust_its_saved_pose(driving):
    driving.restart()
    driving.x, driving.y, driving.theta = 12.0, 8.0, 2.0
    driving.agent.load(driving.master.snapshot(), driving.now)
    driving.run(0.8)
    assert not driving.command("enable").accepted
    assert driving.run(8.0, lambda w: w.agent.localizer.status == "good")
    assert driving.error()[0] < 0.1


def test_agent_that_starts_again_while_its_robot_turns_round_knows_which_way_it_looks():
    world = LittleWorld(pose=(7.0, 2.0, 0.0), guardian="one").ready()
    saved = world.agent.pose_to_store(world.now)
    world.drive_to([(7.0, 2.0), (2.0, 2.0)])
    assert world.run(10.0, lambda w: abs(w.theta) > 2.8)
    world.agent.pose_to_store = lambda _: saved
    world.restart()
    world.agent.load(world.master.snapshot(), world.now)
    world.run(1.0)
    assert world.agent.localizer.status == "good"
    assert world.error() == pytest.approx((0.0, 0.0), abs=0.1)


def test_pose_that_an_operator_gives_is_kept_when_the_first_feedback_of_the_base_follows_a_saved_one(driving):
    driving.restart()
    driving.agent.localizer.initial_pose(driving.x, driving.y, driving.theta)
    given = driving.agent.localizer.detail
    driving.agent.localizer.follow_saved(SavedPose(site="lab", x=1.0, y=2.0, theta=0.0, sigma_xy=0.1, sigma_theta=0.1))
    assert driving.agent.localizer.detail == given != ""


def test_carried_robot_stops_until_an_operator_enables_it(world):
    world.x, world.y, world.theta = 12.0, 7.0, 1.0
    assert world.run(3.0, lambda w: w.state().mode == "PROTECTIVE_STOP")
    assert world.run(8.0, lambda w: w.agent.localizer.status == "good")
    assert world.error()[0] < 0.1
    world.run(3.0)
    assert world.state().mode == "PROTECTIVE_STOP"
    assert world.command("enable").accepted
    world.run(2.5)
    assert world.state().mode == "NORMAL"


def hazard(state, polygon):
    return HazardArea(
        hazard=AreaHazard(
            area="z4", state=state, severity=2, penalty=254, since=0.0, seq=1, epoch=1, cause="test", nodes={}
        ),
        polygon=polygon,
        label="Z4",
        epoch=7,
    )


def test_a_hazard_over_the_robot_stops_it_until_an_operator_enables(driving):
    x = driving.x
    driving.send(ch.HAZARD, hazard("blocked", [(x - 1, 1), (x + 1, 1), (x + 1, 3), (x - 1, 3)]))
    driving.block(x - 1, 1.0, x + 1, 3.0)
    driving.run(0.1)
    assert driving.wheels == (0.0, 0.0)
    state = driving.state()
    assert state.mode == "PROTECTIVE_STOP"
    assert any("blocked area Z4" in reason for reason in state.reasons)
    reply = driving.command("enable")
    assert not reply.accepted
    assert "Z4" in reply.reason


def test_a_no_go_zone_over_the_robot_is_named_with_its_reason(driving):
    x = driving.x
    shape = PolygonShape(points=[(x - 1, 1), (x + 1, 1), (x + 1, 3), (x - 1, 3)])
    zone = Zone(id="wet-floor", kind="BLOCKED", shape=shape, reason="being mopped")
    driving.send(ch.ZONES, ZoneSet(epoch=7, seq=1, zones=[zone], active=[zone.id]))
    driving.block(x - 1, 1.0, x + 1, 3.0)
    driving.run(0.1)
    assert any("wet-floor (being mopped)" in reason for reason in driving.state().reasons)


def test_robot_drives_slowly_in_an_unknown_area(driving):
    driving.send(ch.HAZARD, hazard("unknown", [(1, 1), (9, 1), (9, 3), (1, 3)]))
    driving.run(0.5)
    assert driving.state().mode == "DEGRADED"
    assert sum(driving.wheels) / 2 <= 0.15 + 1e-9


def test_the_speed_layer_limits_the_robot(driving):
    g = driving.geometry
    everywhere = g.window_around(*g.bounds)
    cells = np.full((everywhere.height, everywhere.width), 12, np.uint8)
    for delta in driving.master.write([("speed", everywhere, cells)], [Cause(kind="zone", id="s", state="on")], []):
        driving.send(ch.MAP_DELTA, delta)
    driving.run(1.0)
    assert sum(driving.wheels) / 2 == pytest.approx(0.12, abs=0.005)


def test_zone_of_the_lowest_speed_limit_is_crossed_without_backing_up(world):
    g = world.geometry
    zone = g.window_around(2.4, 1.0, 3.0, 3.0)
    cells = np.full((zone.height, zone.width), 1, np.uint8)
    for delta in world.master.write([("speed", zone, cells)], [Cause(kind="zone", id="s", state="on")], []):
        world.send(ch.MAP_DELTA, delta)
    world.drive_to([(2.0, 2.0), (6.0, 2.0)])
    world.run(35.0, lambda w: w.state().mode != "NORMAL")
    assert (world.state().mode, world.state().reasons) == ("NORMAL", [])
    assert world.x > 2.5
    assert all(left + right >= 0.0 for _, left, right in world.commands)


def test_path_that_begins_elsewhere_holds_the_robot_until_one_begins_where_it_is(world):
    world.drive_to([(8.0, 2.0), (12.0, 2.0)])
    world.run(2.0)
    assert world.state().mode == "HOLD"
    assert "the robot is 6.0 m off its path" in world.state().reasons[0]
    assert world.travelled < 0.01
    world.drive_to([(2.5, 2.0), (6.0, 2.0)], plan_id=2)
    assert world.run(6.0, lambda w: w.travelled > 0.2)
    assert world.state().mode == "NORMAL"


def test_path_longer_than_any_robot_drives_is_not_followed(world):
    world.drive_to([(2.0 + 5.0 * (n % 2), 2.0) for n in range(20_000)])
    world.run(0.5)
    assert world.state().mode == "HOLD"
    assert "the path is longer than 2000 m" in world.state().reasons[0]


class MaskedBehind(AgentCore):
    """An agent whose lidar sees only the robot itself behind."""

    _mounting = Mounting(masks=((2.4, -2.4),))

    def on_lidar_samples(self, samples, now):
        super().on_lidar_samples(self._mounting.apply_to_samples(samples), now)

    def on_scan(self, scan, now):
        super().on_scan(self._mounting.apply(scan), now)


def test_robot_that_sees_nothing_behind_does_not_promise_to_back_off():
    for agent, refused in ((AgentCore, False), (MaskedBehind, True)):
        world = LittleWorld(start_agent=agent).ready()
        world.fault, world.bumped, world.bumper = "the bumper was hit", True, True
        world.run(0.5)
        reply = world.command("back_off")
        assert reply.accepted is not refused
        assert ("the lidar sees nothing behind" in reply.reason) is refused


def test_a_path_of_another_goal_or_an_older_plan_is_not_followed(world):
    world.drive_to(L_PATH, plan_id=5)
    followed = world.state().plan_id
    older = msgspec.structs.replace(world.path, plan_id=4)
    other_goal = msgspec.structs.replace(world.path, plan_id=9, goal_id="g0")
    for path in (older, other_goal):
        world.send(ch.ROBOT_PATH, path)
    with pytest.raises(RefusedMessageError, match="another planner has taken over"):
        world.send(ch.ROBOT_PATH, msgspec.structs.replace(world.path, planner_epoch=2, plan_id=99))
    assert world.state().plan_id == followed == 5
    restarted = msgspec.structs.replace(world.path, planner_epoch=4, plan_id=1)
    world.send(ch.ROBOT_PATH, restarted)
    assert world.state().plan_id == 1


def test_silent_planner_lets_the_robot_drive_slowly_to_the_released_end(world):
    world.drive_to(L_PATH, released=3.0)
    world.path_on = False
    world.run(4.0)
    assert world.state().mode == "DEGRADED"
    world.run(25.0)
    assert world.state().mode == "HOLD"
    assert 4.5 < world.x < 5.05


def test_releases_of_a_plan_that_the_robot_lacks_do_not_keep_its_older_path_alive(world):
    world.drive_to(L_PATH)
    world.run(2.0)
    assert world.state().mode == "NORMAL"
    world.path_on = False
    for _ in range(5):
        world.send(ch.ROBOT_RELEASE, release_of(world.path, plan_id=2))
        world.run(0.5)
    assert world.state().mode == "DEGRADED"
    assert world.state().plan_id == 1
    world.send(ch.ROBOT_PATH, msgspec.structs.replace(world.path, plan_id=2))
    for _ in range(7):
        world.send(ch.ROBOT_RELEASE, release_of(world.path, plan_id=2))
        world.run(0.5)
    assert (world.state().mode, world.state().plan_id) == ("NORMAL", 2)


def test_a_decision_for_a_path_that_was_replaced_is_dropped(driving):
    job = driving.agent.control_job(driving.now)
    late = decide(job)
    driving.decide_on = False
    back = RobotPath(
        plan_id=2, planner_epoch=3, goal_id="g1", points=[(driving.x, 2.0), (3.5, 2.0)], map_epoch=7, map_seq=0,
        released_length=9.0,
    )  # fmt: skip
    driving.path = back
    driving.send(ch.ROBOT_PATH, back)
    driving.agent.accept(late)
    kept = driving.agent._driving.wheels.decision
    assert kept.plan_id == 1  # the old decision expires, the late one did not renew it
    assert kept is not late
    assert seconds_to_rest(driving) <= 1.2


def test_cancel_stops_the_robot_and_lasts_while_the_planner_repeats_the_goal(driving):
    assert driving.command("cancel").accepted
    assert seconds_to_rest(driving) <= 0.6
    driving.run(3.0)
    assert driving.wheels == (0.0, 0.0)
    assert not driving.command("cancel").accepted or driving.state().goal_id == "g1"


def test_trail_for_backing_up_is_forgotten_at_the_end_of_a_mission_since_people_may_move_the_robot(driving):
    trail = driving.agent._driving._recoveries._trail
    assert trail.length > 0.1
    assert driving.command("cancel").accepted
    driving.run(0.3)
    assert trail.length == 0.0


def test_the_first_command_on_a_new_path_closes_its_trace_once(driving):
    driving.drive_to([(driving.x, driving.y), *L_PATH[1:]], plan_id=2, traces=[trace()])
    driving.run(1.0)
    (closed,) = driving.state().traces
    assert closed.area == "z4"
    assert START < closed.path_received <= closed.first_command <= closed.path_received + 0.35
    assert driving.agent.finished_traces() == [closed]
    driving.run(1.0)
    assert driving.agent.finished_traces() == []
    assert driving.state().traces == [closed]


def test_lidar_points_that_the_map_does_not_explain_are_reported_as_obstacles(world):
    assert world.obstacles().points == []
    g = world.geometry
    window = g.window_around(5.0, 1.8, 5.3, 2.2)
    world.solid[window.rows, window.columns] = 1
    world.run(0.5)
    points = np.array(world.obstacles().points)
    assert len(points) >= 3
    assert np.abs(points - (5.0, 2.0)).max() < 0.35
    # once the map shows it because this robot reported it, it is still reported: else it would expire while in sight
    world.block(5.0, 1.8, 5.3, 2.2)
    world.run(0.5)
    assert len(world.obstacles().points) >= 2


def test_view_reaches_to_the_walls_and_to_obstacles_before_them(world):
    def reach(x, y):
        view = world.obstacles().view
        dx, dy = x - view.x, y - view.y
        assert math.hypot(view.x - world.x, view.y - world.y) < 0.1
        return 0.05 * view.reach[int(math.atan2(dy, dx) % math.tau / math.tau * 180)] - math.hypot(dx, dy)

    assert reach(4.0, 1.0) == pytest.approx(0.0, abs=0.15)
    window = world.geometry.window_around(3.0, 1.3, 3.3, 1.6)
    world.solid[window.rows, window.columns] = 1
    world.run(0.5)
    assert reach(3.0, 1.45) == pytest.approx(0.0, abs=0.15)


def test_obstacle_that_others_put_on_the_map_is_not_reported(world):
    world.block(5.0, 1.5, 5.4, 2.5, solid=True)
    world.run(0.5)
    assert world.obstacles().points == []


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"signature": b"x" * 32}, "signature"),
        ({"robot": "r2"}, "robot"),
    ],
)
def test_command_with_wrong_signature_or_robot_changes_nothing(world, change, word):
    command = RobotCommand(kind="reset", robot="r1", operator="ann", nonce="n" * 16, **world.run_and_clock)
    bad = msgspec.structs.replace(sign(command, KEY), **change)
    reply = world.ask(bad)
    assert not reply.accepted
    assert word in reply.reason
    assert world.state().mode == "NORMAL"


def test_too_old_command_changes_nothing(world):
    command = RobotCommand(kind="enable", robot="r1", operator="ann", nonce="n" * 16, **world.run_and_clock)
    world.run(6.0)
    reply = world.ask(sign(command, KEY))
    assert not reply.accepted
    assert "6.0 s old" in reply.reason
    assert world.state().mode == "NORMAL"


def test_command_replayed_to_a_restarted_agent_is_refused(world):
    command = RobotCommand(kind="enable", robot="r1", operator="ann", nonce="n" * 16, **world.run_and_clock)
    assert world.ask(sign(command, KEY)).accepted
    world.restart()
    world.agent.load(world.master.snapshot(), world.now)
    world.run(3.0)
    reply = world.ask(sign(command, KEY))
    assert not reply.accepted
    assert "restarted" in reply.reason
    assert world.state().mode == "INIT"
    assert world.command("enable").accepted


def test_command_of_the_future_is_refused_and_wall_clocks_do_not_matter(world):
    now = world.run_and_clock
    command = RobotCommand(kind="enable", robot="r1", operator="ann", nonce="n" * 16, **now)
    ahead = msgspec.structs.replace(command, issued_at=now["issued_at"] + 4.0)
    assert "future" in world.ask(sign(ahead, KEY)).reason
    query = world.agent.query_handlers()[ch.ROBOT_COMMAND]
    assert query({"robot": "r1"}, sign(command, KEY), Moment(world.now, 17.0)).accepted


@pytest.mark.parametrize("issued_at", [0.0, 1e9, 1e12])
def test_driving_robot_is_stopped_by_anyone_with_any_clock(world, issued_at):
    world.drive_to(L_PATH)
    assert world.run(5.0, lambda w: w.wheels[0] > 0.1)
    stop = RobotCommand(kind="disable", robot="r1", operator="guest", nonce="n" * 16, issued_at=issued_at)
    assert world.ask(stop).accepted
    world.run(0.6)
    assert world.state().mode == "INIT"
    assert world.wheels == (0.0, 0.0)
    assert world.ask(stop).accepted


def test_an_initial_pose_is_refused_while_the_robot_drives(driving):
    assert "disable it first" in driving.command("initial_pose", pose=Pose(x=2.0, y=2.0, theta=0.0)).reason


def test_enable_needs_a_snapshot_and_a_damaged_snapshot_is_refused():
    world = LittleWorld()
    world.run(1.0)
    assert "map" in world.command("enable").reason
    damaged = msgspec.structs.replace(world.master.snapshot(), hash=1)
    with pytest.raises(MapError):
        world.agent.load(damaged, world.now)
    assert world.agent.wants_snapshot(world.now)


def test_published_messages_survive_encoding_and_decoding(driving):
    g = driving.geometry
    window = g.window_around(driving.x + 1.5, 2.3, driving.x + 1.8, 2.6)
    driving.solid[window.rows, window.columns] = 1
    driving.run(1.0)
    report = driving.obstacles()
    messages = [publication.message for publication in driving.published]
    assert {type(message) for message in messages} == {RobotPose, RobotState, RobotObstacles}
    for message in [
        *messages,
        driving.agent.stream(driving.now, driving.stamp),
        driving.agent.pose_to_store(driving.now),
    ]:
        assert msgspec.msgpack.decode(msgspec.msgpack.encode(message), type=type(message)) == message
    assert report.points


def test_a_robot_that_stands_by_commands_each_time_and_evaluates_its_inputs_five_times_a_second(world):
    world.run(1.0)
    agent, evaluated, sent = world.agent, [], []
    step, stream = agent._safety.evaluate, agent.stream
    agent._safety.evaluate = lambda inputs, now, *request: evaluated.append(now) or step(inputs, now, *request)
    agent.stream = lambda now, stamp: sent.append(stream(now, stamp)) or sent[-1]
    assert agent.standing_by
    world.run(2.0)
    assert len(sent) == 20
    assert [command.seq - sent[0].seq for command in sent] == list(range(20))
    assert not any(command.left or command.right or command.reset or command.rest for command in sent)
    assert np.diff(evaluated) == pytest.approx(0.2)
    assert world.state().mode == "NORMAL"
    assert not world.state().loop.late_stops


@pytest.mark.parametrize("event", ["goal", "command"])
def test_a_robot_that_stands_by_evaluates_its_inputs_at_once_when_there_is_something_to_do(world, event):
    agent = world.agent
    for offset in range(1, 5):
        world.run(1.0 + 0.05 * offset)
        agent.stream(world.now, world.stamp)
        assert agent.repeats(world.now)
        if event == "goal":
            world.drive_to(L_PATH, goal_id=f"g{offset}")
        else:
            assert world.command("disable").accepted
        assert not agent.repeats(world.now)
        assert agent.cancel_goal() or world.command("enable").accepted


def test_what_an_operator_changes_on_a_robot_that_stands_by_is_published_with_the_next_tick(world):
    world.run(1.0)
    agent = world.agent
    end = world.now + 10.0
    while not agent.standing_by or agent.tick(world.moment):
        assert world.now < end, f"the robot has not stood by without a word: {world.state()}"
        world.run(0.01)
    assert world.command("disable").accepted
    world.published = agent.tick(world.moment)
    assert [state.mode for state in world.published_on(ch.ROBOT_STATE)] == ["INIT"]


def test_a_mode_that_a_robot_standing_by_finds_is_published_with_the_next_tick(world):
    world.run(1.0)
    agent = world.agent
    end = world.now + 10.0
    while agent.repeats(world.now):
        assert world.now < end, f"the robot looks at nothing: {world.state()}"
        world.run(0.01)
    agent.tick(world.moment)
    world.bumper = True
    world.run(0.04)
    assert agent.safety.mode == "NORMAL", "it has not looked yet"
    assert agent.tick(world.moment) == ()
    agent.stream(world.now, world.stamp)
    assert agent.standing_by
    world.published = agent.tick(world.moment)
    assert [state.mode for state in world.published_on(ch.ROBOT_STATE)] == ["FAULT"]


def test_a_docked_robot_with_a_mission_that_sees_nothing_behind_stays_enabled_on_its_dock_and_says_why():
    world = LittleWorld(pose=(1.4, 2.0, 0.0), glass=[(0.9, 0.9, 1.05, 3.1)]).ready()
    world.docked, world.stopped = True, ON_CHARGER
    world.drive_to(L_PATH)
    world.run(1.0)
    assert world.command("enable").accepted
    world.run(1.0)
    state = world.state()
    assert (state.mode, state.enabled) == ("HOLD", True)
    assert any("leave its dock" in reason and "sees nothing behind" in reason for reason in state.reasons)


def test_a_robot_that_was_sent_to_its_dock_stands_by_only_when_it_has_given_up():
    dock, staging = Pose(x=3.9, y=2.0, theta=0.0), Pose(x=3.2, y=2.0, theta=0.0)
    config = {"dock": dock, "staging": staging, "finds_dock": True}
    world = LittleWorld(start_agent=lambda agent, seed: AgentCore(replace(agent, **config), seed)).ready()
    assert world.agent.standing_by
    assert world.command("dock").accepted
    assert world.state().goal_id is None
    assert not world.agent.standing_by
    assert world.run(11.0, lambda w: w.agent.standing_by), "no planner gives it a goal: it gives up after 10 s"
    assert any("no goal in front of its dock" in warning for warning in world.state().reasons)


def test_a_robot_on_a_mission_or_of_unknown_pose_never_stands_by(world):
    assert world.agent.standing_by
    world.drive_to(L_PATH)
    assert not world.agent.standing_by
    assert not LittleWorld().agent.standing_by


@pytest.mark.parametrize(("lost", "reason"), [("lidar_on", "the lidar has been silent"), ("base_on", "the guardian")])
def test_a_robot_that_stands_by_stops_for_lidar_and_guardian_within_a_fifth_of_a_second_more(world, lost, reason):
    world.run(1.0)
    setattr(world, lost, False)
    assert world.run(0.5, lambda w: w.state().mode == "PROTECTIVE_STOP")
    assert any(reason in text for text in world.state().reasons)
