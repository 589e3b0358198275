from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from little_world import AGENT, KEY, LittleWorld

from fog_contracts.commands import sign
from fog_contracts.grid import GridGeometry
from fog_contracts.handlers import Moment
from fog_contracts.messages import Pose, Reason, ReasonCode, RefusalCode, RobotCommand
from fog_runtime.configuration import parts
from robot_agent import registry
from robot_agent.agent.core import AgentCore
from robot_agent.agent.operator_commands import OperatorCommands, initial_pose_refusal

AT = Moment(10.0, 1_000.0)


class FakeRobot:
    """Records its commands."""

    def __init__(self, refusal=None, goal=None):
        self.refusal = refusal
        self.goal = goal
        self.commands = []

    def request(self, request, now):
        self.commands.append((request, now))
        return SimpleNamespace(refusal=self.refusal, mode="NORMAL")

    def cancel_goal(self):
        self.commands.append("cancel")
        return self.goal

    def set_initial_pose(self, pose):
        self.commands.append(pose)
        return self.refusal


def answer(robot, kind, *, key=KEY, at=AT, **more):
    command = RobotCommand(
        kind=kind, robot="r1", operator="ann", nonce="n" * 16, boot=AGENT.boot, issued_at=AT.now, **more
    )
    return OperatorCommands(AGENT, robot).answer(sign(command, key), at)


@pytest.mark.parametrize("kind", ["enable", "disable", "reset"])
def test_requests_go_to_the_safety_gate_whose_refusal_is_the_reply(kind):
    robot = FakeRobot()
    assert answer(robot, kind).accepted
    assert robot.commands == [(kind, 10.0)]
    refusal = Reason(RefusalCode.CAUSE_REMAINS, "the cause is still there: " + "x" * 600, [ReasonCode.CLIFF])
    reply = answer(FakeRobot(refusal=refusal), kind)
    assert (reply.accepted, reply.code, reply.causes) == (False, "cause_remains", ["cliff"])
    assert reply.reason == refusal[:500]


def test_cancel_replies_with_the_goal_or_refuses_without_one():
    assert "g7" in answer(FakeRobot(goal="g7"), "cancel").reason
    assert answer(FakeRobot(), "cancel").code == "no_goal"


def test_an_initial_pose_is_passed_on_with_its_refusal():
    pose = Pose(x=1.0, y=2.0, theta=0.5)
    robot = FakeRobot()
    assert answer(robot, "initial_pose", pose=pose).accepted
    assert robot.commands == [pose]
    refusal = Reason(RefusalCode.POSE_OFF_MAP, "off the map")
    assert answer(FakeRobot(refusal=refusal), "initial_pose", pose=pose).code == "pose_off_map"


@pytest.mark.parametrize("more", [{"key": b"x" * 32}, {"at": Moment(15.1, 1_000.0)}, {"at": Moment(9.9, 1_000.0)}])
def test_command_with_wrong_key_or_age_is_not_executed(more):
    robot = FakeRobot()
    assert not answer(robot, "enable", **more).accepted
    assert robot.commands == []


@pytest.mark.parametrize(
    ("pose", "geometry", "at_rest", "code"),
    [
        (None, True, True, "pose_missing"),
        (Pose(x=0.5, y=0.5, theta=0.0), False, True, "map_missing"),
        (Pose(x=0.5, y=0.5, theta=0.0), True, False, "driving"),
        (Pose(x=1.5, y=0.5, theta=0.0), True, True, "pose_off_map"),
        (Pose(x=0.05, y=0.5, theta=0.0), True, True, "pose_in_wall"),
        (Pose(x=0.5, y=0.5, theta=0.0), True, True, None),
    ],
)
def test_impossible_initial_pose_is_refused_with_the_reason(pose, geometry, at_rest, code):
    static = np.zeros((10, 10), np.uint8)
    static[:, 0] = 254
    replica = SimpleNamespace(geometry=GridGeometry(10, 10, 0.1, 0.0, 0.0) if geometry else None, static=static)
    refusal = initial_pose_refusal(pose, replica, at_rest=at_rest)
    assert refusal is None if code is None else refusal.code == code


def test_a_profile_that_is_not_installed_is_refused_with_the_remedy(monkeypatch):
    monkeypatch.setattr(parts, "names", lambda _group: [])
    world = LittleWorld(start_agent=partial(AgentCore, find_profile=registry.profile)).ready()
    assert world.command("disable").accepted
    world.run(0.6)
    reply = world.command("profile_full")
    assert not reply.accepted
    assert reply.code == "no_profile"
    assert "install fognav-experiments there and restart its agent, or use fog" in reply.reason
    assert world.state().profile == "fog"
    assert world.command("profile_fog").accepted
