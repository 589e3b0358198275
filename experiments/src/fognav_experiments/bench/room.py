"""Measures how robots make room for one another: many missions on one floor, led by the planner's core alone.

The robots are blind: each follows what is released of its path, a few centimetres beside it, and knows nothing of the
others, so that only leases keep two bodies apart. Contact is exact: circles that move along straight lines within a
step touch when their least distance in it is below the sum of their radii. Each robot gets another goal at random as
soon as it has reached one. Hazards come and go meanwhile.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from dataclasses import dataclass, field
from statistics import mean
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
from scipy.ndimage import label

from fog_contracts import channels as ch
from fog_contracts.costs import DEFAULT_INFLATION, FREE, INSCRIBED, LETHAL
from fog_contracts.geometry import lengths_along
from fog_contracts.grid import GridGeometry, StaticMap, Window
from fog_contracts.handlers import Moment
from fog_contracts.messages import Cause, Pose, RobotGoal, RobotPath, RobotPose, RobotRelease, RobotState
from fog_contracts.replica import MasterMap
from fog_kernels.inflation import inflate, inflation_table
from fog_runtime.configuration.site import load_site
from planner.core import PlannerCore

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from fog_contracts.handlers import Publication

STEP_S: Final = 0.1
SPEED_M_S: Final = 0.3
TURN_RAD_S: Final = 1.5
RADIUS_M: Final = 0.17
OFF_PATH_M: Final = 0.04
"""How far beside its path a robot drives, and how wrong the pose is that it tells."""
STATE_STEPS: Final = 10
DEADLOCK_S: Final = 120.0
"""A robot with a path that has not moved for so long, nor half so long the one that it waits for, is in one."""
HAZARD_M: Final = 1.0
HAZARD_EVERY_S: Final = (20.0, 60.0)
HAZARD_LASTS_S: Final = (10.0, 30.0)
NEAREST_M: Final = 2.0
"""Nothing appears nearer to a robot's centre than this."""
_APART_M: Final = 1.0
"""Goals and starts of different robots are at least so far from one another."""
RESOLUTION: Final = 0.05
AISLES_M: Final = {"aisles": 1.8, "narrow": 1.2}
"""Width (m) of the aisles by a floor's name: two robots pass in one, and do not in the other."""


def aisles(width: float, number: int = 6, length: float = 27.0) -> StaticMap:
    """Return a floor of parallel aisles of a length (m) and width (m) between shelves, with a passage at both ends."""
    shelf, passage, wall = 1.2, 2.5, 0.2
    size_x, size_y = length + 2 * passage + 2 * wall, number * width + (number - 1) * shelf + 2 * wall
    geometry = GridGeometry(round(size_x / RESOLUTION), round(size_y / RESOLUTION), RESOLUTION, 0.0, 0.0)
    cells = np.full(geometry.shape, LETHAL, np.uint8)

    def free(left: float, bottom: float, right: float, top: float) -> None:
        x0, y0, x1, y1 = (round(value / RESOLUTION) for value in (left, bottom, right, top))
        cells[y0:y1, x0:x1] = FREE

    for begin in (wall, size_x - wall - passage):
        free(begin, wall, begin + passage, size_y - wall)
    for aisle in range(number):
        bottom = wall + aisle * (width + shelf)
        free(wall, bottom, size_x - wall, bottom + width)
    return StaticMap(geometry, cells)


class ChangingMap:
    """The map-service's part: the floor with hazards on it, and the deltas between versions."""

    def __init__(self, floor: StaticMap) -> None:
        self.geometry = floor.geometry
        self._static = floor.cells
        self._table = inflation_table(self.geometry.resolution, DEFAULT_INFLATION)
        cost = inflate(np.ascontiguousarray(floor.cells), self._table)
        self.master = MasterMap("room", self.geometry, floor.cells, cost, 1)
        self.free = self._free(cost)
        self._hazards: dict[str, Window] = {}
        self._ends: dict[str, float] = {}
        self._next_hazard = math.inf

    def _free(self, cost: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Return the cells of the largest part of the floor that hangs together, columns and rows."""
        parts, _ = label(cost < INSCRIBED)
        largest = 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
        return np.argwhere(parts == largest)[:, ::-1]

    def place(self, rng: np.random.Generator) -> tuple[float, float]:
        """Return a random place (m) where a robot may be on the empty floor."""
        column, row = self.free[rng.integers(len(self.free))].tolist()
        x, y = self.geometry.centre(column, row)
        return float(x), float(y)

    def start(self, core: PlannerCore, now: float, rng: np.random.Generator) -> None:
        """Load the empty floor into the planner."""
        core.load(self.master.snapshot(), now)
        self._next_hazard = now + rng.uniform(*HAZARD_EVERY_S)

    def step(self, core: PlannerCore, robots: Sequence[BlindRobot], at: Moment, rng: np.random.Generator) -> None:
        """Let boxes come and go where no robot is near, and tell the planner of the map."""
        core.handlers()[ch.MAP_HEARTBEAT]({}, self.master.heartbeat(at.now), at)
        changed = [name for name, end in self._ends.items() if at.now >= end]
        for name in changed:
            del self._ends[name], self._hazards[name]
        if at.now >= self._next_hazard:
            self._next_hazard = at.now + rng.uniform(*HAZARD_EVERY_S)
            x, y = self.place(rng)
            if all(math.dist((x, y), (robot.x, robot.y)) > NEAREST_M for robot in robots):
                half, name = HAZARD_M / 2.0, f"h{at.now:.1f}"
                self._hazards[name] = self.geometry.window_around(x - half, y - half, x + half, y + half)
                self._ends[name] = at.now + rng.uniform(*HAZARD_LASTS_S)
                changed.append(name)
        if changed:
            self._change(core, at)

    def _change(self, core: PlannerCore, at: Moment) -> None:
        """Tell the planner of the hazards as they are now."""
        raw = self._static.copy()
        for window in self._hazards.values():
            raw[window.rows, window.columns] = LETHAL
        old, new = self.master.layers["cost"], inflate(raw, self._table)
        rows, columns = np.nonzero(old != new)
        if not len(rows):
            return
        x, y = int(columns.min()), int(rows.min())
        window = Window(x, y, int(columns.max()) - x + 1, int(rows.max()) - y + 1)
        cells = np.ascontiguousarray(new[window.rows, window.columns])
        for delta in self.master.write([("cost", window, cells)], [Cause(kind="hazard", id="h", state="blocked")], []):
            core.handlers()[ch.MAP_DELTA]({}, delta, at)


@dataclass
class BlindRobot:
    """A robot that follows what is released of its path, and sees nothing."""

    id: str
    rng: np.random.Generator
    x: float
    y: float
    theta: float = 0.0
    path: RobotPath | None = None
    corners: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    lengths: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    along: float = 0.0
    goal: RobotGoal | None = None
    off: float = 0.0
    given_at: float = 0.0
    driven: float = 0.0
    waited: float = 0.0
    without_way: float = 0.0
    still_since: float = 0.0
    missions: list[float] = field(default_factory=list)
    """How long (s) each mission took that has ended."""
    deadlocked: bool = False

    def take(self, path: RobotPath) -> None:
        """Follow a path, or stand where there is none."""
        known, self.path = self.path, path
        if known is not None and known.plan_id == path.plan_id:
            return
        self.corners = np.array(path.points, dtype=np.float64).reshape(-1, 2)
        self.lengths, self.along = lengths_along(self.corners), 0.0

    @property
    def reached(self) -> bool:
        """Whether it is at its goal."""
        pose = self.goal.pose if self.goal else None
        return pose is not None and math.dist((self.x, self.y), (pose.x, pose.y)) < 0.15

    def drive(self, now: float) -> None:
        """Drive for a step along what is released."""
        if self.path is None or not len(self.corners) or self.path.refusal is not None:
            self.still_since = now if self.path is None or self.path.refusal is not None else self.still_since
            self.without_way += STEP_S
            return
        end = min(self.path.released_length, float(self.lengths[-1]))
        if end - self.along < 0.02:
            self.waited += STEP_S
            return
        self.off += float(self.rng.normal(0.0, 0.01)) - 0.1 * self.off
        off = min(max(self.off, -OFF_PATH_M), OFF_PATH_M)
        step = min(SPEED_M_S * STEP_S, end - self.along)
        aim_x, aim_y = self._point(self.along + step)
        ahead_x, ahead_y = self._point(self.along + step + 0.05)
        heading = math.atan2(ahead_y - aim_y, ahead_x - aim_x) if (ahead_x, ahead_y) != (aim_x, aim_y) else self.theta
        turn = math.remainder(heading - self.theta, math.tau)
        self.theta += min(max(turn, -TURN_RAD_S * STEP_S), TURN_RAD_S * STEP_S)
        if abs(turn) > 0.5:
            return
        self.along += step
        self.driven += step
        to_x, to_y = aim_x - off * math.sin(heading), aim_y + off * math.cos(heading)
        moved = math.dist((to_x, to_y), (self.x, self.y))
        share = min(1.0, 2.0 * SPEED_M_S * STEP_S / max(moved, 1e-9))  # back to its path no faster than that
        self.x, self.y = self.x + share * (to_x - self.x), self.y + share * (to_y - self.y)
        self.still_since = now

    def _point(self, along: float) -> tuple[float, float]:
        x, y = (float(np.interp(along, self.lengths, self.corners[:, i])) for i in (0, 1))
        return x, y

    def pose(self, stamp: float) -> RobotPose:
        """Return the pose that it tells."""
        wrong = (self.rng.uniform(-OFF_PATH_M, OFF_PATH_M, 2) / 2.0).tolist()
        return RobotPose(
            x=self.x + wrong[0], y=self.y + wrong[1], theta=self.theta, covariance=[0.0] * 9, v=0.0, w=0.0,
            radius=RADIUS_M, height=0.1, stamp=stamp,
        )  # fmt: skip

    def state(self, *, reached: bool) -> RobotState:
        """Return the state that it tells."""
        path, goal = self.path, self.goal
        return RobotState(
            mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=goal.goal_id if goal else None, map_epoch=1,
            map_seq=0, plan_id=path.plan_id if path else None, planner_epoch=path.planner_epoch if path else None,
            goal_reached=reached,
        )  # fmt: skip


class Floor:
    """One run: a floor, robots with one mission after another, hazards that come and go."""

    def __init__(self, map_: ChangingMap, robots: int, seed: int, *, own_goals: bool = False) -> None:
        """Put the robots at random places; `own_goals`: each draws its goals alone, whatever the others do."""
        self.map = map_
        self._rng = np.random.default_rng(seed)
        self.now, self.contacts, self.least_gap_m = 100.0, 0, math.inf
        self.core = PlannerCore(epoch=1)
        self.robots: list[BlindRobot] = []
        for number in range(robots):
            x, y = self._place([(robot.x, robot.y) for robot in self.robots], self._rng)
            robot = BlindRobot(f"r{number + 1}", np.random.default_rng((seed, number)), x, y, still_since=self.now)
            self.robots.append(robot)
        self.map.start(self.core, self.now, self._rng)
        alone = [np.random.default_rng((seed, number, 1)) for number in range(robots)]
        self._draws = {robot.id: rng if own_goals else self._rng for robot, rng in zip(self.robots, alone, strict=True)}
        self._in_contact: set[tuple[str, str]] = set()
        self._steps = 0
        self.deadlocks: list[str] = []
        self.longest_wait_s = 0.0
        """How long a robot with a path stood at most."""

    def _place(self, others: Sequence[tuple[float, float]], rng: np.random.Generator) -> tuple[float, float]:
        while True:
            place = self.map.place(rng)
            if all(math.dist(place, other) > _APART_M for other in others):
                return place

    def run(self, seconds: float) -> None:
        """Let robots drive for so long (s)."""
        until = self.now + seconds
        while self.now < until:
            self.step()

    def step(self) -> None:
        """Simulate a step."""
        self.now = round(self.now + STEP_S, 3)
        self._steps += 1
        at = Moment(self.now, self.now)
        core, handlers = self.core, self.core.handlers()
        self.map.step(core, self.robots, at, self._rng)
        before = [(robot.x, robot.y) for robot in self.robots]
        for robot in self.robots:
            robot.drive(self.now)
        self._note_contacts(before)
        for number, robot in enumerate(self.robots):
            ids = {"robot": robot.id}
            if reached := robot.reached and robot.goal is not None:
                robot.missions.append(self.now - robot.given_at)
            handlers[ch.ROBOT_POSE](ids, robot.pose(self.now), at)
            if reached or (self._steps + number) % STATE_STEPS == 0:
                handlers[ch.ROBOT_STATE](ids, robot.state(reached=reached), at)
            if reached or robot.goal is None:
                self._send(robot)
            self._note_deadlock(robot)
        found = list(core.tick(at))
        for job in core.jobs(at):
            job.run()
            core.add(job, self.now)
        core.missions.pop_reached()
        self._deliver(found)

    def _send(self, robot: BlindRobot) -> None:
        others = [(other.goal.pose.x, other.goal.pose.y) for other in self.robots if other is not robot
                  and other.goal is not None and other.goal.pose is not None]  # fmt: skip
        x, y = self._place([*others, (robot.x, robot.y)], self._draws[robot.id])
        robot.goal = RobotGoal(goal_id=f"{robot.id}-{self._steps}", pose=Pose(x=x, y=y, theta=0.0))
        robot.path, robot.given_at, robot.still_since = None, self.now, self.now
        self.core.set_goal(robot.id, robot.goal, any_heading=True)

    def _deliver(self, publications: Sequence[Publication]) -> None:
        robots = {robot.id: robot for robot in self.robots}
        for publication in publications:
            message = publication.message
            robot = robots.get(publication.ids.get("robot", ""))
            if robot is None or robot.goal is None:
                continue
            if isinstance(message, RobotPath) and message.goal_id == robot.goal.goal_id:
                robot.take(message)
            elif isinstance(message, RobotRelease) and robot.path is not None:
                robot.path = robot.path.after(message)

    def _note_contacts(self, before: Sequence[tuple[float, float]]) -> None:
        for one, other in itertools.combinations(range(len(self.robots)), 2):
            a, b = self.robots[one], self.robots[other]
            gap = _least_distance(before[one], (a.x, a.y), before[other], (b.x, b.y)) - 2.0 * RADIUS_M
            self.least_gap_m = min(self.least_gap_m, gap)
            pair = a.id, b.id
            if gap < 0.0 and pair not in self._in_contact:
                self.contacts += 1
                self._in_contact.add(pair)
            elif gap > 0.01:
                self._in_contact.discard(pair)

    def _note_deadlock(self, robot: BlindRobot) -> None:
        plan = self.core.missions.of(robot.id).plan
        if plan is not None and plan.waits:  # for the end of a block, not for a robot
            robot.still_since = self.now
        still = self.now - robot.still_since
        self.longest_wait_s = max(self.longest_wait_s, still)
        others = {other.id: other for other in self.robots}
        awaited = others.get(self.core.leases.waits_for(robot.id) or "")
        dead = still >= DEADLOCK_S and (awaited is None or self.now - awaited.still_since >= 0.5 * DEADLOCK_S)
        if dead and not robot.deadlocked:
            self.deadlocks.append(f"{robot.id} at ({robot.x:.1f}, {robot.y:.1f}) since {robot.still_since:.0f} s")
        robot.deadlocked = dead


def _least_distance(
    a: tuple[float, float], a_end: tuple[float, float], b: tuple[float, float], b_end: tuple[float, float]
) -> float:
    """Return the least distance of two points that move along straight lines at the same time."""
    x, y = b[0] - a[0], b[1] - a[1]
    vx, vy = (b_end[0] - b[0]) - (a_end[0] - a[0]), (b_end[1] - b[1]) - (a_end[1] - a[1])
    square = vx * vx + vy * vy
    share = min(1.0, max(0.0, -(x * vx + y * vy) / square)) if square > 0.0 else 0.0
    return math.hypot(x + share * vx, y + share * vy)


class Run(msgspec.Struct, frozen=True):
    """What one run gave: times in s, `waited` as a share of the robots' time."""

    seed: int
    robots: int
    seconds: float
    took: list[float]
    """How long each mission took that has ended."""
    waited: float
    longest_wait: float
    contacts: int
    gap_m: float | None
    """The least distance of two robots' rims; None of one robot."""
    deadlocks: list[str]
    made: dict[str, int]
    driven_m: float
    without_way: float
    """The share of the robots' time in which they had no path."""
    ended: list[int]
    """How many missions of each robot have ended."""


def play(floor: StaticMap, robots: int, seed: int, seconds: float) -> Run:
    """Let robots drive on a floor for so long (s); return what happened."""
    return drive(Floor(ChangingMap(floor), robots, seed), seed, seconds)


def drive(run: Floor, seed: int, seconds: float) -> Run:
    """Let the robots of a run drive for so long (s); return what happened."""
    run.run(seconds)
    robots = len(run.robots)
    return Run(
        seed,
        robots,
        seconds,
        [time for robot in run.robots for time in robot.missions],
        sum(robot.waited for robot in run.robots) / (robots * seconds),
        run.longest_wait_s,
        run.contacts,
        None if math.isinf(run.least_gap_m) else run.least_gap_m,
        run.deadlocks,
        {str(kind): count for kind, count in run.core.leases.made.items()},
        sum(robot.driven for robot in run.robots),
        sum(robot.without_way for robot in run.robots) / (robots * seconds),
        [len(robot.missions) for robot in run.robots],
    )


def summary(runs: Sequence[Run]) -> dict[str, object]:
    """Return the figures of runs of the same kind: times in s, lengths in m."""
    took = [time for run in runs for time in run.took]
    hours = sum(run.robots * run.seconds for run in runs) / 3600.0
    made = sum((Counter(run.made) for run in runs), Counter[str]())
    gap = min((run.gap_m for run in runs if run.gap_m is not None), default=None)
    return {
        "missions": len(took),
        "missions_per_robot_hour": round(len(took) / hours, 1),
        "mission_s": round(mean(took), 1) if took else None,
        "waiting_share": round(mean(run.waited for run in runs), 4),
        "longest_wait_s": round(max(run.longest_wait for run in runs), 1),
        "contacts": sum(run.contacts for run in runs),
        "least_gap_m": None if gap is None else round(gap, 3),
        "deadlocks": sum(len(run.deadlocks) for run in runs),
        "deadlocked": [f"seed {run.seed}: {what}" for run in runs for what in run.deadlocks],
        "room_made": dict(made),
    }


def floor_named(name: str, sites: Path) -> StaticMap:
    """Return a floor by its name: `aisles`, `narrow`, or a site of the folder; raises `ValueError` for another one."""
    if name in AISLES_M:
        return aisles(AISLES_M[name])
    if not (sites / name / "site.toml").is_file():
        raise ValueError(f"no floor {name!r}: take {', '.join(AISLES_M)} or a site of {sites}")
    map_ = load_site(sites / name).map
    return StaticMap(map_.geometry, map_.cells)
