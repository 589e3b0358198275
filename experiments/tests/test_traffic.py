"""Bytes per robot: for the longest routes of the site estig, when a hazard closes an area, and in steady state."""

from __future__ import annotations

import itertools
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.codec import encode
from fog_contracts.handlers import Moment, Publication
from fog_contracts.messages import (
    AreaHazard,
    AreaState,
    Message,
    Pose,
    RobotGoal,
    RobotPath,
    RobotPose,
    RobotState,
    Trace,
)
from fog_runtime.configuration.site import LoadedSite, load_site
from fognav_experiments.processes import MapProcess, PlannerProcess
from fognav_sim.drive.hazard import path_length
from map_service.core import MapCore
from map_service.registry import make_layers
from planner.core import PlannerCore

if TYPE_CHECKING:
    from fog_contracts.messages import Place

PATH_LIMIT = 1536
CHANGE_LIMIT = 2048
STEADY_LIMIT = 1024
STEADY = {"map_heartbeat", "robot_goal", "robot_release"}
"""The channels with messages while nothing changes."""
START_S = 1.0


@pytest.fixture(scope="module")
def estig() -> LoadedSite:
    return load_site(Path(__file__).parents[2] / "sites" / "estig")


class Fog:
    """Map-service and planner with one robot that stands still; `sent`: bytes by channel."""

    def __init__(self, site: LoadedSite) -> None:
        self.bus = Bus(site.site.id)
        self.definitions = site.site.definitions()
        layers = make_layers(site.map, site.site.layers)
        self.map = MapProcess(
            MapCore(site.site.id, site.map, 40, layers=layers, definitions=self.definitions), self.bus
        )
        self.planner = PlannerProcess(PlannerCore(40), self.bus)
        self.sent: dict[str, int] = defaultdict(int)
        self.path: RobotPath | None = None
        self.now = START_S
        self.at = (0.0, 0.0)
        robot = [c for c in ch.CHANNELS.values() if c.kind == "pub" and "robot-agent" in c.subscribers]
        for channel in robot:
            self._count(channel)
        self.map.load_zones([], self.moment)
        for area in self.definitions:
            self.set_area(area.id, "clear", seq=1)

    @property
    def moment(self) -> Moment:
        return Moment(self.now, 1_760_000_000.0 + self.now)

    def _count(self, channel: ch.Channel) -> None:
        def count(_ids: object, message: Message, _at: Moment) -> list[Publication]:
            self.sent[channel.name] += len(encode(channel, message))
            if isinstance(message, RobotPath):
                self.path = message
            return []

        self.bus.subscribe({channel: count})

    def set_area(self, area: str, state: AreaState, seq: int) -> None:
        stamp = self.moment.stamp
        nodes = next(d.nodes for d in self.definitions if d.id == area)
        blocked = state == "blocked"
        trace = Trace(area=area, epoch=40, seq=seq, first_reading=stamp, confirmed=stamp) if blocked else None
        hazard = AreaHazard(
            area=area, state=state, severity=3 if blocked else 0,
            penalty=254 if blocked else 0, since=stamp, seq=seq, epoch=40, cause="4 of 4 readings below 1.20 m",
            nodes=dict.fromkeys(nodes, state), trace=trace,
        )  # fmt: skip
        self.bus.publish([Publication(ch.AREA_HAZARD, hazard, {"area": area})])

    def send_to(self, goal_id: str, start: Place, goal: Place) -> RobotPath:
        """Put the robot at a place and send it to another; return its path."""
        self.at = (start.x, start.y)
        pose = Pose(x=goal.x, y=goal.y, theta=0.0)
        self.planner.set_goal("r1", RobotGoal(goal_id=goal_id, pose=pose), any_heading=True)
        self.run(0.2)
        assert self.path is not None
        assert self.path.goal_id == goal_id
        return self.path

    def run(self, seconds: float) -> dict[str, int]:
        """Run for some time; return the bytes by channel that a robot was sent meanwhile."""
        self.sent.clear()
        for _ in range(round(seconds / 0.1)):
            self.now += 0.1
            x, y = self.at
            pose = RobotPose(
                x=x, y=y, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.1, stamp=0.0
            )
            own = [Publication(ch.ROBOT_POSE, pose, {"robot": "r1"})]
            if self.path is not None:
                state = RobotState(
                    mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=self.path.goal_id, map_epoch=1,
                    map_seq=1, plan_id=self.path.plan_id, planner_epoch=self.path.planner_epoch,
                )  # fmt: skip
                own.append(Publication(ch.ROBOT_STATE, state, {"robot": "r1"}))
            self.bus.publish(own)
            self.map.tick(self.moment)
            self.planner.deliver(self.moment)
            self.planner.tick(self.moment)
            self.planner.deliver(self.moment)
        return dict(self.sent)


@pytest.fixture(scope="module")
def fog(estig: LoadedSite) -> Fog:
    fog = Fog(estig)
    fog.run(1.0)
    return fog


def test_paths_between_all_places_are_small(fog: Fog, estig: LoadedSite) -> None:
    sizes, longest = [], 0.0
    for (start, a), (goal, b) in itertools.permutations(estig.site.places.items(), 2):
        path = fog.send_to(f"{start}-{goal}", a, b)
        assert path.points, path.refusal
        longest = max(longest, path_length(path.points))
        sizes.append(len(encode(ch.ROBOT_PATH, path)))
    assert longest > 50.0
    assert max(sizes) <= PATH_LIMIT, sizes


def test_a_hazard_and_the_new_path_cost_a_robot_at_most_two_kilobytes(fog: Fog, estig: LoadedSite) -> None:
    demo = estig.site.demo
    assert demo is not None
    start, goal = estig.site.places[demo.start], estig.site.places[demo.goal]
    replanned = []
    for seq, area in enumerate(demo.areas, start=1):
        before = fog.send_to(f"past-{area}", start, goal).plan_id
        fog.run(1.0)
        fog.set_area(area, "blocked", seq=2 * seq)
        sent = fog.run(3.0)
        change = {channel: size for channel, size in sent.items() if channel not in STEADY}
        assert sum(change.values()) <= CHANGE_LIMIT, (area, change)
        assert change["map_delta"] > 0
        if fog.path is not None and fog.path.plan_id != before:
            assert [trace.area for trace in fog.path.traces] == [area]
            replanned.append(area)
        fog.set_area(area, "clear", seq=2 * seq + 1)
        fog.run(3.0)
    assert replanned


def test_nothing_but_heartbeat_goal_and_release_is_sent_while_nothing_changes(fog: Fog, estig: LoadedSite) -> None:
    start, goal = list(estig.site.places.values())[:2]
    fog.send_to("steady", start, goal)
    fog.run(3.0)
    sent = fog.run(10.0)
    assert sent.keys() == STEADY
    assert sum(sent.values()) / 10.0 <= STEADY_LIMIT, sent
