"""Measures the planner's core with many robots: a hazard across all paths, and goals that are cut off and back.

All robots are in rooms along the west of one corridor, all goals along its east. One hazard closes the corridor
between them, so that every path must be found anew, through another corridor. Another one closes the whole floor. A
robot's time runs from the map's delta, decoded, to its path
or refusal, encoded; robots that are planned later wait for those before them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
import psutil

from fog_contracts import channels as ch
from fog_contracts.codec import encode
from fog_contracts.costs import DEFAULT_INFLATION, INSCRIBED, LETHAL
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    AreaHazard,
    Cause,
    HazardArea,
    MapDelta,
    Pose,
    RectangleShape,
    RobotGoal,
    RobotPath,
    Zone,
    ZoneSet,
)
from fog_contracts.replica import MasterMap
from fog_contracts.shapes import rasterize, rasterize_shape
from fog_kernels.components import Components
from fog_kernels.inflation import inflate, inflate_window, inflation_table
from fognav_experiments.bench.common import CORRIDOR, corridor_rows, following, standing
from planner.core import PlannerCore

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from fog_contracts.grid import StaticMap, Window
    from fog_contracts.handlers import Publication

    Polygon = list[tuple[float, float]]
    PointXY = tuple[float, float]

_QUIET_S: Final = 120.0
"""After a trial the clock is put forward so far that no earlier switch delays another one."""
_STRIP: Final = 2.0
"""Width (m) of the hazards."""


class Trip(NamedTuple):
    """Where a robot stands, and its goal (m, frame `map`)."""

    place: PointXY
    goal: PointXY


class FleetMap:
    """The map-service's part: the map with its zones and at most one hazard, and the deltas between its versions."""

    def __init__(self, floor: StaticMap, zones: int, rng: np.random.Generator) -> None:
        self.floor = floor
        self.geometry = floor.geometry
        rows = corridor_rows(floor.geometry.bounds[3])
        self.corridor = float(rows[len(rows) // 2])
        """The y (m) of the corridor's middle."""
        self._table = inflation_table(floor.geometry.resolution, DEFAULT_INFLATION)
        self._with_zones = floor.cells.copy()
        self.zones = [self._zone(number, rng) for number in range(zones)]
        for zone in self.zones:
            window, mask = rasterize_shape(zone.shape, self.geometry)
            self._with_zones[window.rows, window.columns][mask] = LETHAL
        self._raw = self._with_zones.copy()
        self._cost = inflate(self._raw, self._table)
        self.master = MasterMap("bench", self.geometry, floor.cells, self._cost, 1)

    def _zone(self, number: int, rng: np.random.Generator) -> Zone:
        """Return a no-go zone of up to a metre, anywhere on the floor."""
        left, bottom, right, top = self.geometry.bounds
        x, y = rng.uniform(left + 1.0, right - 2.0), rng.uniform(bottom + 1.0, top - 2.0)
        opposite = round(x + rng.uniform(0.3, 1.0), 2), round(y + rng.uniform(0.3, 1.0), 2)
        shape = RectangleShape(corner=(round(x, 2), round(y, 2)), opposite=opposite)
        return Zone(id=f"zone-{number}", kind="BLOCKED", shape=shape, reason="bench")

    def zone_set(self) -> ZoneSet:
        """Return the message that lists the zones, all of them in force."""
        return ZoneSet(epoch=1, seq=1, zones=self.zones, active=[zone.id for zone in self.zones])

    def free_cells(self, left: float, right: float) -> NDArray[np.int64]:
        """Return cells ((n, 2), columns and rows) along the corridor, between two x (m), with a way to the rest."""
        components = Components(self._cost)
        labels = components.labels(*self.geometry.whole)
        counts = np.bincount(labels[labels >= 0])
        rows, columns = np.nonzero((labels == int(np.argmax(counts))) & (self._cost < INSCRIBED // 2))
        x = self.geometry.origin_x + (columns + 0.5) * self.geometry.resolution
        y = self.geometry.origin_y + (rows + 0.5) * self.geometry.resolution
        chosen = (x >= left) & (x <= right) & (np.abs(y - self.corridor) <= 5.0)
        return np.stack((columns[chosen], rows[chosen]), axis=1)

    def put(self, polygon: Polygon) -> list[MapDelta]:
        """Put a hazard onto the map."""
        window, mask = rasterize(polygon, self.geometry)
        self._raw[window.rows, window.columns][mask] = LETHAL
        return self._write(window)

    def clear(self, polygon: Polygon) -> list[MapDelta]:
        """Take a hazard off the map."""
        window, _ = rasterize(polygon, self.geometry)
        self._raw[window.rows, window.columns] = self._with_zones[window.rows, window.columns]
        return self._write(window)

    def _write(self, window: Window) -> list[MapDelta]:
        inflate_window(self._raw, self._table, *window, self._cost)
        grown = self.geometry.clip(window.grown(self._table.reach))
        cells = np.ascontiguousarray(self._cost[grown.rows, grown.columns])
        cause = Cause(kind="hazard", id="bench", state="blocked")
        return self.master.write([("cost", grown, cells)], [cause], [])


def place_fleet(map_: FleetMap, robots: int, goals: int, rng: np.random.Generator) -> dict[str, Trip]:
    """Return each robot's place in the west of the floor, and its goal in the east; robots share goals in turn."""
    left, _, right, _ = map_.geometry.bounds
    width = right - left
    starts, ends = map_.free_cells(left, left + 0.2 * width), map_.free_cells(right - 0.2 * width, right)
    places = [map_.geometry.centre(*starts[rng.integers(len(starts))].tolist()) for _ in range(robots)]
    targets = [map_.geometry.centre(*ends[rng.integers(len(ends))].tolist()) for _ in range(goals)]
    return {f"r{number}": Trip(place, targets[number % goals]) for number, place in enumerate(places)}


def closures(map_: FleetMap, trials: int) -> Iterator[tuple[Polygon, Polygon]]:
    """Yield the hazards of each trial: one across the corridor, one across the whole floor."""
    left, bottom, right, top = map_.geometry.bounds
    for number in range(trials):
        x = left + (0.35 + 0.3 * number / max(1, trials - 1)) * (right - left)
        yield strip(x, map_.corridor - CORRIDOR / 2, map_.corridor + CORRIDOR / 2), strip(x, bottom, top)


def hazard_message(polygon: Polygon, seq: int, *, blocked: bool) -> HazardArea:
    """Return the hazard as the map-service publishes it."""
    hazard = AreaHazard(
        area="bench",
        state="blocked" if blocked else "clear",
        severity=3 if blocked else 0,
        penalty=LETHAL if blocked else 0,
        since=0.0,
        seq=seq,
        epoch=1,
        cause="bench",
    )
    return HazardArea(hazard=hazard, polygon=polygon, epoch=1)


def strip(x: float, bottom: float, top: float) -> Polygon:
    """Return a hazard across the floor around `x`, from `bottom` to `top` (m)."""
    half = _STRIP / 2
    return [(x - half, bottom), (x + half, bottom), (x + half, top), (x - half, top)]


@dataclass
class Times:
    """The times of one trial (ms): until each robot had its answer, and until the last refusal had its reason."""

    answered: list[float] = field(default_factory=list)
    worked: list[float] = field(default_factory=list)
    """The first ones by the processor's time, which other programs lengthen little."""
    explained: float = 0.0


class Fleet:
    """A planner's core with robots in the west of a floor and goals in its east."""

    def __init__(self, map_: FleetMap, robots: int, goals: int, rng: np.random.Generator) -> None:
        self.map = map_
        self.core = PlannerCore(epoch=1)
        self.now = 100.0
        self.bytes_sent = 0
        self._trips = place_fleet(map_, robots, goals, rng)
        self.core.load(map_.master.snapshot(), self.now)
        self._deliver(ch.ZONES, map_.zone_set())
        for number, (robot, trip) in enumerate(self._trips.items()):
            x, y = trip.goal
            goal = RobotGoal(goal_id=f"g{number}", pose=Pose(x=x, y=y, theta=0.0))
            self.core.set_goal(robot, goal, any_heading=True)
        self.settle()

    @property
    def _moment(self) -> Moment:
        return Moment(self.now, self.now)

    def _deliver(self, channel: ch.Channel, message: object, **ids: str) -> None:
        self.core.handlers()[channel](ids, message, self._moment)

    def _refresh(self) -> None:
        """Deliver a heartbeat of the map and every robot's pose."""
        self._deliver(ch.MAP_HEARTBEAT, self.map.master.heartbeat(self.now))
        for robot, ((x, y), _) in self._trips.items():
            self._deliver(ch.ROBOT_POSE, standing(x, y, self.now), robot=robot)

    def settle(self) -> None:
        """Let all searches and jobs end, those that have to wait too; nothing is measured."""
        for _ in range(4):
            self.now += _QUIET_S / 4
            self._refresh()
            self._receive(self.core.tick(self._moment))
            run_jobs(self.core, self._moment)
        self.now += 0.1
        self._refresh()
        self._receive(self.core.tick(self._moment))

    def _receive(self, publications: Sequence[Publication]) -> None:
        """Let robots name the paths that they receive in their states: the planner then does not repeat them."""
        for publication in publications:
            path = publication.message
            if isinstance(path, RobotPath):
                self._deliver(ch.ROBOT_STATE, following(path), **publication.ids)

    def trial(self, deltas: Sequence[MapDelta], hazard: HazardArea) -> Times:
        """Deliver a change of the map; return when each robot had its answer."""
        times, answered = Times(), set[str]()
        sent: list[Publication] = []
        self.now += 0.1
        self._refresh()
        begun, worked = time.perf_counter(), time.thread_time()

        def send(publications: Sequence[Publication]) -> None:
            sent.extend(publications)
            for publication in publications:
                message = publication.message
                if not isinstance(message, RobotPath):
                    continue
                self.bytes_sent += len(encode(ch.ROBOT_PATH, message))
                if publication.ids["robot"] not in answered:
                    answered.add(publication.ids["robot"])
                    times.answered.append(1000.0 * (time.perf_counter() - begun))
                    times.worked.append(1000.0 * (time.thread_time() - worked))

        self._deliver(ch.HAZARD, hazard, area="bench")
        for delta in deltas:
            self._deliver(ch.MAP_DELTA, delta)
        run_cycle(self.core, self._moment, send)
        run_jobs(self.core, self._moment)
        run_cycle(self.core, self._moment, send)
        times.explained = 1000.0 * (time.perf_counter() - begun)
        self._receive(sent)
        return times


def run_cycle(core: PlannerCore, at: Moment, send: Callable[[Sequence[Publication]], None]) -> None:
    """Run one planning cycle as the process does: each path is sent before the next search begins."""
    for robot in core.plan(at):
        send(core.publish_for(robot, at))
    send(core.publish(at))


def run_jobs(core: PlannerCore, at: Moment) -> None:
    """Run the core's jobs, which the process runs on other threads."""
    for job in core.jobs(at):
        job.run()
        core.add(job, at.now)


def measure(map_: FleetMap, fleet: Fleet, trials: int, on_progress: Callable[[int, int], object]) -> dict[str, object]:
    """Run the trials and return the figures; times in ms."""
    replans: list[float] = []
    worked: list[float] = []
    cut_off: list[float] = []
    explained: list[float] = []
    back: list[float] = []
    sent = deltas_sent = 0
    for number, (across, wall) in enumerate(closures(map_, trials)):
        deltas = map_.put(across)
        before = fleet.bytes_sent
        times = fleet.trial(deltas, hazard_message(across, 4 * number, blocked=True))
        replans += times.answered
        worked += times.worked
        sent += fleet.bytes_sent - before
        deltas_sent += sum(len(encode(ch.MAP_DELTA, delta)) for delta in deltas)
        fleet.trial(map_.clear(across), hazard_message(across, 4 * number + 1, blocked=False))
        fleet.settle()
        times = fleet.trial(map_.put(wall), hazard_message(wall, 4 * number + 2, blocked=True))
        cut_off.append(max(times.answered, default=0.0))
        explained.append(times.explained)
        times = fleet.trial(map_.clear(wall), hazard_message(wall, 4 * number + 3, blocked=False))
        back.append(max(times.answered, default=0.0))
        fleet.settle()
        on_progress(number + 1, trials)
    return {
        "replans": len(replans),
        "replan_p50_ms": percentile(replans, 50),
        "replan_p99_ms": percentile(replans, 99),
        "replan_cpu_p50_ms": percentile(worked, 50),
        "replan_cpu_p99_ms": percentile(worked, 99),
        "cut_off_ms": percentile(cut_off, 50),
        "cut_off_explained_ms": percentile(explained, 50),
        "back_ms": percentile(back, 50),
        "rss_mb": round(psutil.Process().memory_info().rss / 1e6, 1),
        "goal_fields_mb": round(fleet.core.fields_bytes / 1e6, 1),
        "bytes_per_robot": round(sent / max(1, len(replans)) + deltas_sent / trials),
    }


def percentile(values: Sequence[float], share: float) -> float:
    """Return a percentile, rounded; 0 without values."""
    return round(float(np.percentile(values, share)), 2) if values else 0.0
