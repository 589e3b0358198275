"""Profiles of navigation: what each of them plans by, waits for, and ignores."""

from __future__ import annotations

import msgspec
import pytest
from little_world import L_PATH, LittleWorld

from fog_contracts import channels as ch
from fog_contracts.handlers import Moment
from fog_contracts.messages import AreaHazard, HazardArea, PolygonShape, Zone, ZoneSet
from fognav_experiments.rigs import AGENT

RING = [(1, 1, 9, 2.4), (1, 5, 9, 6.4), (1, 1, 2.4, 6.4), (7.6, 1, 9, 6.4), (4.0, 2.4, 4.8, 3.0), (5.6, 6.4, 6.8, 7.0)]
"""Corridors around a block, with niches: from the lower left to the lower right there are two ways."""
ACROSS = (5.0, 1.0, 5.4, 2.4)


def polygon(left, bottom, right, top):
    return [(left, bottom), (right, bottom), (right, top), (left, top)]


def ring(profile):
    world = LittleWorld(rooms=RING, size=(10.0, 8.0), pose=(2.0, 1.7, 0.0), start_agent=AGENT).ready()
    return switched(world, profile)


def switched(world, profile):
    assert world.command("disable").accepted
    world.run(0.6)
    reply = world.command(f"profile_{profile}")
    assert reply.accepted, reply
    assert world.command("enable").accepted
    world.run(0.6)
    assert world.state().profile == profile
    return world


def send_goal(world, goal):
    """Give the robot a goal, and paths that lead nowhere: only a robot that drives by the fog follows them."""
    world.drive_to([(2.0, 1.7), (2.0, 1.8)], goal_id="g")
    world.goal = msgspec.structs.replace(
        world.goal, pose=msgspec.structs.replace(world.goal.pose, x=goal[0], y=goal[1]), any_heading=True
    )
    world.send(ch.ROBOT_GOAL, world.goal)


def hazard(state, penalty, seq=1):
    area = AreaHazard(area="z1", state=state, severity=1, penalty=penalty, since=0.0, seq=seq, epoch=1, cause="t")
    return HazardArea(hazard=area, polygon=polygon(*ACROSS), epoch=7)


@pytest.mark.parametrize("profile", ["default", "full"])
def test_a_robot_that_plans_for_itself_reaches_its_goal_without_the_planner(profile):
    world = ring(profile)
    world.path_on = False
    send_goal(world, (8.0, 1.7))
    assert world.run(40.0, lambda w: w.state().goal_reached), world.state().reasons
    assert not world.collided
    assert 5.5 < world.travelled < 7.0


def test_default_drives_up_to_what_its_lidar_sees_and_turns_back():
    world = ring("default")
    world.block(*ACROSS, solid=True, publish=False)
    world.send(ch.HAZARD, hazard("blocked", 254))
    send_goal(world, (8.0, 1.7))
    assert world.run(90.0, lambda w: w.state().goal_reached), world.state().reasons
    assert world.travelled > 12.0
    assert not world.collided


@pytest.mark.parametrize("profile", ["default", "full"])
@pytest.mark.drive
def test_a_robot_that_plans_for_itself_takes_another_way_round_a_place_that_it_does_not_fit_through(profile):
    # Seven cells of 5 cm: the middle one is free on the costmap, where a body of 0.34 m has not its padding.
    necked = [(1, 1, 5, 2.4), (5, 1.5, 5.2, 1.85), (5.2, 1, 9, 2.4), *RING[1:]]
    world = switched(
        LittleWorld(rooms=necked, size=(10.0, 8.0), pose=(2.0, 1.7, 0.0), start_agent=AGENT).ready(), profile
    )
    send_goal(world, (8.0, 1.7))
    assert world.run(120.0, lambda w: w.state().goal_reached), world.state().reasons
    assert world.travelled > 12.0
    assert not world.collided


FAR = [(1, 1, 16, 3), (3, 3, 4, 4.4), (6.5, 3, 8.5, 3.6), (11, 3, 11.8, 4.0)]
"""A corridor of 15 m with niches: from its one end the lidar, which reaches 12 m, does not see the other."""
FAR_GOAL = (13.6, 2.0)
ON_FAR_GOAL = (13.5, 1.8, 13.7, 2.2)


def towards_an_occupied_goal(profile):
    """Return a robot on its way to a goal 11.6 m away on which its lidar has seen something."""
    world = switched(LittleWorld(rooms=FAR, size=(17.0, 6.0), pose=(2.0, 2.0, 0.0), start_agent=AGENT).ready(), profile)
    world.path_on = False
    send_goal(world, FAR_GOAL)
    empty = world.solid.copy()
    world.block(*ON_FAR_GOAL, solid=True, publish=False)
    world.run(1.5)
    return world, empty


@pytest.mark.parametrize("profile", ["default", "full"])
def test_a_robot_goes_and_looks_at_a_goal_that_it_saw_occupied_only_from_far_away(profile):
    # Nothing is seen beyond the goal from there: no later scan tells that the place is free again.
    world, empty = towards_an_occupied_goal(profile)
    world.solid[:] = empty
    assert world.run(60.0, lambda w: w.state().goal_reached), world.state().reasons
    assert not world.collided


@pytest.mark.parametrize("profile", ["default", "full"])
def test_a_robot_holds_before_a_goal_that_it_sees_occupied_from_near(profile):
    world, _ = towards_an_occupied_goal(profile)
    assert world.run(60.0, lambda w: w.state().mode == "HOLD")
    world.run(5.0)
    assert any("the goal is occupied" in reason for reason in world.state().reasons)
    assert 1.5 < FAR_GOAL[0] - world.x < 4.0
    assert not world.collided


def test_a_robot_with_no_way_left_looks_at_what_it_saw_only_from_far_away_and_holds():
    world = ring("default")
    world.block(*ACROSS, solid=True, publish=False)
    world.block(5.0, 5.0, 5.4, 6.4, solid=True, publish=False)
    send_goal(world, (8.0, 1.7))
    assert world.run(120.0, lambda w: any("no path leads" in reason for reason in w.state().reasons))
    travelled = world.travelled
    world.run(20.0)
    assert world.state().mode == "HOLD"
    assert world.travelled - travelled < 1.0
    assert not world.collided


def test_full_avoids_a_hazard_that_only_the_fog_knows_and_default_does_not():
    lengths = {}
    for profile in ("default", "full"):
        world = ring(profile)
        world.send(ch.HAZARD, hazard("blocked", 254))
        send_goal(world, (8.0, 1.7))
        assert world.run(90.0, lambda w: w.state().goal_reached), world.state().reasons
        lengths[profile] = world.travelled
    assert lengths["default"] < 7.0
    assert lengths["full"] > 12.0


def test_full_avoids_a_no_go_zone_and_forgets_one_that_is_lifted():
    world = ring("full")
    zone = Zone(id="wet", kind="BLOCKED", shape=PolygonShape(points=polygon(*ACROSS)))
    world.send(ch.ZONES, ZoneSet(epoch=7, seq=1, zones=[zone], active=["wet"]))
    send_goal(world, (8.0, 1.7))
    world.run(1.0)
    assert world.state().goal_distance > 11.0
    world.send(ch.ZONES, ZoneSet(epoch=7, seq=2, zones=[zone], active=[]))
    world.command("cancel")
    world.run(1.0)
    send_goal(world, (8.0, 1.7))
    world.goal = msgspec.structs.replace(world.goal, goal_id="g2")
    world.send(ch.ROBOT_GOAL, world.goal)
    world.run(1.0)
    assert world.state().goal_distance < 7.0


def test_a_profile_is_judged_by_the_sources_that_it_uses():
    modes = {}
    for profile in ("default", "full", "fog"):
        world = ring(profile)
        world.heartbeats_on = world.path_on = False
        send_goal(world, (8.0, 1.7))
        world.run(6.0)
        modes[profile] = world.state().mode
    assert modes == {"default": "NORMAL", "full": "DEGRADED", "fog": "HOLD"}


def test_no_way_left_is_refused_and_tried_again():
    world = ring("full")
    world.send(ch.HAZARD, hazard("blocked", 254))
    zone = Zone(id="wet", kind="BLOCKED", shape=PolygonShape(points=polygon(5.0, 5.0, 5.4, 6.4)))
    world.send(ch.ZONES, ZoneSet(epoch=7, seq=1, zones=[zone], active=["wet"]))
    send_goal(world, (8.0, 1.7))
    world.run(2.0)
    assert world.state().mode == "HOLD"
    assert any("no path leads to the goal" in reason for reason in world.state().reasons)
    world.send(ch.ZONES, ZoneSet(epoch=7, seq=2, zones=[], active=[]))
    assert world.run(90.0, lambda w: w.state().goal_reached), world.state().reasons


def test_a_profile_is_switched_at_rest_only():
    world = LittleWorld(start_agent=AGENT).ready()
    world.drive_to(L_PATH)
    world.run(3.0)
    reply = world.command("profile_default")
    assert not reply.accepted
    assert "disable it first" in reply.reason
    assert world.state().profile == "fog"


def test_path_that_another_profile_has_searched_is_dropped_when_it_is_found_after_the_switch():
    world = ring("default")
    send_goal(world, (8.0, 1.7))
    world.run(1.0)
    world.command("disable")
    world.run(0.6)
    search = world.agent.search(world.now + 0.2)
    assert search is not None
    world.send(ch.HAZARD, hazard("blocked", 254))
    assert world.command("profile_full").accepted
    world.agent.on_found(search.run(), Moment(world.now, world.now))
    assert world.state().plan_id is None


def test_paths_of_the_robots_own_are_numbered_on_from_profile_to_profile():
    world = ring("full")
    send_goal(world, (8.0, 1.7))
    seen = []
    for profile in ("default", "fog", "full", "default"):
        assert world.run(3.0, lambda w: w.state().plan_id)
        seen.append((world.state().planner_epoch, world.state().plan_id))
        switched(world, profile)
    own = [plan for epoch, plan in seen if epoch == 0]
    assert len(own) == 3
    assert own == sorted(set(own))


def test_snapshot_that_arrives_after_the_switch_leaves_the_robots_own_map_and_its_plans_alone():
    world = LittleWorld(rooms=RING, size=(10.0, 8.0), pose=(2.0, 1.7, 0.0), start_agent=AGENT).ready()
    late = world.master.snapshot()
    switched(world, "default")
    world.block(*ACROSS, solid=True, publish=False)
    send_goal(world, (8.0, 1.7))
    turned = world.run(40.0, lambda w: (w.state().plan_id or 0) >= 2 and w.state().mode == "NORMAL")
    assert turned, "it has seen the closure and searched another way"
    own, version, plan = world.agent.replica, world.agent.replica.version, world.state().plan_id
    world.agent.load(late, world.now)
    assert world.agent.replica is own
    assert own.version == version
    goal = msgspec.structs.replace(world.goal.pose, x=6.2, y=6.5)
    world.goal = msgspec.structs.replace(world.goal, goal_id="h", pose=goal)
    world.send(ch.ROBOT_GOAL, world.goal)
    seen = []

    def reached(world):
        seen.append(world.state())
        return seen[-1].goal_id == "h" and seen[-1].goal_reached

    assert world.run(90.0, reached), world.state().reasons
    assert {state.mode for state in seen} == {"NORMAL"}
    plans = [state.plan_id for state in seen if state.plan_id is not None]
    assert plans == sorted(plans)
    assert plans[-1] > plan
    assert not world.collided


def test_a_robot_that_returns_to_the_fog_waits_for_the_newest_map_and_drives_by_it():
    world = ring("default")
    world.block(*ACROSS, publish=True)
    world.run(1.0)
    switched(world, "fog")
    assert world.run(3.0, lambda w: w.state().mode == "HOLD"), world.state().reasons
    assert world.agent.wants_snapshot(world.now)
    world.agent.load(world.master.snapshot(), world.now)
    world.run(3.0)
    assert world.state().mode == "NORMAL"
    assert world.agent.replica.version == world.master.version
