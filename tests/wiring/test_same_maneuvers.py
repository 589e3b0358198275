"""Lockstep and the live services decide the same about docks and profiles, too.

One recorded drive: a robot goes to its dock and charges, leaves it for a goal, and goes on by another profile.
"""

from __future__ import annotations

import asyncio
import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import CommandKind, CommandReply, Pose, RobotGoal
from fog_runtime.configuration.site import LoadedSite
from fognav_experiments.rigs import OPERATOR_KEY, System, moment
from planner.stops import Order
from robot_agent.agent.recording import input_log as log
from robot_agent.registry import profile


def module(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(f"maneuvers_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    loaded = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


pytestmark = pytest.mark.timeout(900)
HERE = Path(__file__).parent
same = module(HERE / "test_same_decisions.py")
live_services, ring = same.live_services, same.ring

SEED = 3
DOCK = Pose(x=0.78, y=1.5, theta=3.1415926)
GOAL = Pose(x=1.5, y=3.4, theta=0.0)
GOAL_ID = "goal-after-charging"
ENABLE, DOCKING, GOES, DISABLE, SWITCH, AGAIN, STEPS = 350, 400, 1500, 2000, 2080, 2090, 2500
COMMANDS: dict[int, CommandKind] = {
    ENABLE: "enable", DOCKING: "dock", DISABLE: "disable", SWITCH: "profile_full", AGAIN: "enable",
}  # fmt: skip


def site_with_dock() -> LoadedSite:
    loaded = ring.ring_site()
    robot = msgspec.structs.replace(loaded.site.robots[0], dock=DOCK)
    robot = msgspec.structs.replace(robot, start=robot.staging)
    return LoadedSite(msgspec.structs.replace(loaded.site, robots=[robot]), loaded.map, loaded.directory)


def goal(stamp: float) -> RobotGoal:
    return RobotGoal(goal_id=GOAL_ID, pose=GOAL, place=None, stamp=stamp)


def drive_in_lockstep() -> Any:
    site, entries = site_with_dock(), []
    bus = same.RecordingBus(site.site.id)

    def logged(config: Any, seed: int) -> Any:  # as the system's own maker of agents
        return log.LoggedAgent(config, seed, entries.append, profile)

    system = System(site, site.site.robots[0], SEED, bus=bus, make_agent=logged)
    run = same.Run(bus, replace(entries[0].config, operator_key=OPERATOR_KEY))
    for step in range(1, STEPS + 1):
        bus.step = step
        entries.clear()
        system.step()
        run.hardware.append([entry for entry in entries if isinstance(entry, same.HARDWARE)])
        run.wheels += [entry.command for entry in entries if isinstance(entry, log.WheelsCommanded)]
        run.times.append(system.now)
        at = moment(system.now)
        if step in COMMANDS:
            command = same.signed(COMMANDS[step], at.now)
            command = same.sign(msgspec.structs.replace(command, nonce=f"{step:016d}"), OPERATOR_KEY)
            run.replies.append(bus.query(ch.ROBOT_COMMAND, command, CommandReply, at, robot="r1"))
        if step == GOES:
            system.fog.planner.set_goal("r1", goal(at.stamp), any_heading=True)
        system.fog.deliver(at)
    return run


async def drive_live(recorded: Any) -> Any:
    asyncio.get_running_loop().set_default_executor(live_services.InlineExecutor())
    site = site_with_dock()
    bus = same.RecordingBus(site.site.id)
    run = same.Run(bus, recorded.config)
    live = live_services.LiveServices(site, recorded.config, SEED, bus)
    await live.start()
    for step, now in enumerate(recorded.times, 1):
        await same.replay(live, bus, recorded, step)
        if step in COMMANDS:
            command = same.signed(COMMANDS[step], now)
            command = same.sign(msgspec.structs.replace(command, nonce=f"{step:016d}"), OPERATOR_KEY)
            run.replies.append(await live.run(live.query(ch.ROBOT_COMMAND, command, CommandReply, robot="r1")))
        if step == GOES:
            await live.run(live.planner.send(Order("r1", GOAL, "tester", any_heading=True)))
        await live.run_until_idle()
    run.wheels = live.link.sent
    await live.stop()
    return run


@pytest.fixture(scope="module")
def lockstep() -> Any:
    return drive_in_lockstep()


@pytest.fixture(scope="module")
def live(lockstep: Any) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        for name in (
            "planner.query_queue",
            "robot_agent.agent.edges.map_loader",
            "robot_agent.agent.service",
            "fog_runtime.concurrency",
        ):
            patch.setattr(f"{name}.ThreadPoolExecutor", live_services.InlineExecutor)
        # The planner names missions at random.
        goals = [message.goal_id for _, _, message in lockstep.decisions()["robot_goal"] if message.pose is not None]
        names = iter(dict.fromkeys(goals))
        patch.setattr("planner.tours.persistence.secrets.token_hex", lambda _: next(names))
        return asyncio.run(drive_live(lockstep))


def test_recorded_drive_docks_charges_leaves_its_dock_and_switches_its_profile(lockstep):
    assert [reply.accepted for reply in lockstep.replies] == [True] * len(COMMANDS), lockstep.replies
    states = [(step, state) for step, _, state in lockstep.decisions()["robot_state"]]
    docked = [step for step, state in states if state.docked]
    assert DOCKING < docked[0] < GOES, "it has docked before it gets its goal"
    assert any(step > GOES and state.mode == "DOCK" for step, state in states), "it leaves its dock"
    assert any(step > docked[-1] and state.mode == "NORMAL" for step, state in states)
    assert states[-1][1].profile == "full"
    assert {command.maneuver for command in lockstep.wheels} >= {None, "seek_dock", "leave_dock"}


def test_live_services_dock_leave_the_dock_and_switch_profiles_as_lockstep_does(lockstep, live):
    assert live.replies == lockstep.replies
    expected, found = lockstep.decisions(), live.decisions()
    assert found.keys() == expected.keys()
    for channel, decisions in expected.items():
        for live_decision, decision in zip(found[channel], decisions, strict=False):
            assert live_decision == decision, channel
        assert len(found[channel]) == len(decisions), channel
    assert live.wheels == lockstep.wheels
