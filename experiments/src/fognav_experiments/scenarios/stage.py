"""Lets a scenario happen to a drive in lockstep, and to what its sensor nodes report."""

from __future__ import annotations

import itertools
import math
import random
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Final, Literal, Protocol, runtime_checkable

import msgspec

from fog_contracts.geometry import distance_to_polygon
from fog_contracts.messages import PolygonShape, Pose, SimObstacle, Zone
from fognav_experiments.rigs import moment
from fognav_experiments.scenarios.description import (
    BadLine,
    BlindLidar,
    BusyRadio,
    ClockChange,
    Command,
    DeadAgent,
    DeceivedNode,
    FaultyNode,
    FrozenLidar,
    HeldWheel,
    Hole,
    HungAgent,
    Kidnapping,
    LinkGap,
    NoGoZone,
    Obstacle,
    Person,
    Push,
    Restart,
    SilentLidar,
    SilentNode,
    SlewedNode,
    SlowLink,
    SpeedZone,
)
from fognav_sim.hardware import STEP_S
from fognav_sim.sensors import Deception

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.messages import AreaState, Id, NodeCalibration, NodeConfig, NodeReading
    from fognav_experiments.lockstep import LockstepDrive
    from fognav_experiments.rigs import FogProcessName
    from fognav_experiments.scenarios.description import AnyEvent
    from fognav_sim.nodes import SensorNode
    from fognav_sim.world import World


Source = Literal["fog", "map-service", "aggregator", "planner", "agent", "lidar", "new turns", "base", "floor"]
"""What may be lost: messages to the robot, a process of the fog, agent, lidar, its new turns, base, floor ahead."""
_REPEAT_STEPS: Final = 10
_PERSON_M: Final = 0.2
"""Radius of somebody who walks."""
_PERSON_RING: Final = [(math.cos(k * math.tau / 8), math.sin(k * math.tau / 8)) for k in range(8)]
_PERSON_WAITS_M: Final = 1.0
_GAP_S: Final = 0.3


@runtime_checkable
class StallingLidar(Protocol):
    """The emulator of a lidar that can fall silent."""

    stalled: bool
    frozen: bool
    frozen_revolutions: int


class Stage:
    """Begins and ends the events of a drive; `seed` is that of the times that a busy radio takes.

    A subclass is told of what nothing published shows.
    """

    def __init__(self, run: LockstepDrive, events: Sequence[AnyEvent], seed: int = 1) -> None:
        self._run = run
        self._began = run.now
        self._waiting = list(enumerate(events))
        self._ends: list[tuple[float, Callable[[], object]]] = []
        self._repeated: list[Callable[[], bool]] = []
        self._steps = 0
        self._gaps = (0, 0)
        self._random = random.Random(seed)  # noqa: S311  # repeatable, not a secret

    def on_lost(self, source: Source, *, lost: bool) -> None:
        """Note that the robot does not get this from now on, or gets it again."""

    def on_acknowledged(self, zone: Zone) -> None:
        """Note that an operator's zone was acknowledged."""

    def on_obstacle(self, area: str, *, stands: bool) -> None:
        """Note that something stands before the nodes of an area, or is gone."""

    @property
    def elapsed(self) -> float:
        """Time since the goal was given, s."""
        return self._run.now - self._began

    def step(self) -> None:
        """Begin and end what is due."""
        elapsed, driven = self.elapsed, self._run.driven
        due = [(n, event) for n, event in self._waiting if elapsed >= event.at_s and driven >= event.at_m]
        for number, event in due:
            self._waiting.remove((number, event))
            self._run.log_event(f"event {number}: {type(event).__name__}")
            self._begin(f"event-{number}", event)
        for end in [end for end in self._ends if end[0] <= elapsed]:
            self._ends.remove(end)
            end[1]()
        if self._steps % _REPEAT_STEPS == 0:
            self._repeated = [repeat for repeat in list(self._repeated) if repeat()]
        self._steps += 1

    def _begin(self, name: str, event: AnyEvent) -> None:  # noqa: C901, PLR0912, PLR0915  # a table of the kinds of events
        run = self._run
        match event:
            case Obstacle():
                if not self._place(name, event):
                    self._repeated.append(lambda: not self._place(name, event))
            case Person():
                self._repeated.append(partial(self._walk, name, event, self.elapsed))
            case NoGoZone():
                self._put_zone(Zone(id=name, kind="BLOCKED", shape=PolygonShape(points=event.polygon)), event.seconds)
            case SpeedZone():
                shape = PolygonShape(points=event.polygon)
                self._put_zone(Zone(id=name, kind="SPEED_LIMIT", shape=shape, speed=event.speed), event.seconds)
            case SilentNode():
                self._replace_node(event.node, lambda _node: [], event.seconds)
            case FaultyNode():
                fault = event.fault
                self._replace_node(event.node, lambda node: [FaultyNodeSim(node, fault)], event.seconds)
            case SlewedNode():
                rate = event.rate
                self._replace_node(event.node, lambda node: [SlewedNodeSim(node, rate)], 0.0)
            case LinkGap():
                self._gap(event.seconds, (event.down, event.up))
            case SlowLink():
                self._delay(event.delay_s)
                self._later(event.seconds, partial(self._delay, 0.0))
            case DeceivedNode():
                self._run.world.deceived[event.node] = Deception(
                    scale=event.scale, offset=event.offset, lost=event.lost, stray=event.stray
                )
                self._later(event.seconds, partial(self._run.world.deceived.pop, event.node, None))
            case ClockChange():
                self._set_clock(event)
            case BusyRadio():
                self._busy(event)
            case Restart():
                run.system.fog.stop(event.process)
                self.on_lost(event.process, lost=True)
                self._later(event.seconds, partial(self._start_again, event.process))
            case HungAgent():
                self._hang(hung=True)
                self._later(event.seconds, partial(self._hang, hung=False))
            case DeadAgent():
                run.robot.kill()
                self.on_lost("agent", lost=True)
                self._later(event.seconds, self._start_agent)
            case SilentLidar():
                self._stall(stalled=True)
                self._later(event.seconds, partial(self._stall, stalled=False))
            case FrozenLidar():
                self._freeze(event.turns)
                self._later(event.seconds, partial(self._freeze, 0))
            case BadLine():
                self._disturb(event, begins=True)
                self._later(event.seconds, partial(self._disturb, event, begins=False))
            case Hole():
                if not self._open(name, event):
                    self._repeated.append(lambda: not self._open(name, event))
            case Command():
                run.robot.command(event.command)
            case HeldWheel():
                self._hold(event.wheel, held=True)
                self._later(event.seconds, partial(self._hold, event.wheel, held=False))
            case Push():
                run.world.turn(event.turn)
            case Kidnapping():
                run.world.kidnap(Pose(x=event.to[0], y=event.to[1], theta=event.theta))
            case BlindLidar():
                self._blind((event.begin, event.end))
                self._later(event.seconds, partial(self._blind, None))

    def _place(self, name: str, event: Obstacle) -> bool:
        """Place an obstacle; return False if the robot is still too near."""
        x, y, _ = self._run.world.pose
        if event.keep_m and distance_to_polygon(event.polygon, x, y) < event.keep_m:
            return False
        self._run.world.place(SimObstacle(id=name, polygon=event.polygon, height=event.height), soft=event.soft)
        if event.area is not None:
            self.on_obstacle(event.area, stands=True)
        self._later(event.seconds, partial(self._remove, name, event.area))
        return True

    def _open(self, name: str, event: Hole) -> bool:
        """Open a hole; return False if the robot is still too near."""
        x, y, _ = self._run.world.pose
        if distance_to_polygon(event.polygon, x, y) < max(event.keep_m, self._run.world.robot.radius):
            return False
        self._run.world.holes[name] = list(event.polygon)
        return True

    def _remove(self, name: str, area: str | None) -> None:
        self._run.world.remove(name)
        if area is not None:
            self.on_obstacle(area, stands=False)

    def _walk(self, name: str, event: Person, began: float) -> bool:
        """Move somebody on; return whether he is still there."""
        legs = list(itertools.pairwise(event.line))
        left = (self.elapsed - began) * event.speed
        x, y, _ = self._run.world.pose
        for (x0, y0), (x1, y1) in legs:
            length = math.dist((x0, y0), (x1, y1))
            if left <= length:
                at = (x0 + (x1 - x0) * left / length, y0 + (y1 - y0) * left / length)
                if math.dist(at, (x, y)) >= _PERSON_WAITS_M:
                    ring = [(at[0] + dx * _PERSON_M, at[1] + dy * _PERSON_M) for dx, dy in _PERSON_RING]
                    self._run.world.place(SimObstacle(id=name, polygon=ring, height=1.7))
                return True
            left -= length
        self._run.world.remove(name)
        return False

    def _transmit(self, event: BusyRadio, until: float) -> bool:
        """Draw the times of the next 0.1 s; return whether the radio is still busy."""
        if self.elapsed >= until:
            self._delay(0.0)
            return False
        self._delay(self._time(event))
        if self._random.random() < event.gaps_per_min * _REPEAT_STEPS * STEP_S / 60.0:
            by = self._random.choice(((1, 0), (0, 1), (1, 1)))
            self._gap(max(_GAP_S * math.exp(self._random.gauss(0.0, 1.0)), 2 * STEP_S), by)
        return True

    def _busy(self, event: BusyRadio) -> None:
        self._repeated.append(partial(self._transmit, event, self.elapsed + event.seconds))
        for node in [node.node.id for node in self._run.system.fog.nodes]:
            self._replace_node(node, lambda now: [LateNodeSim(now, partial(self._time, event))], event.seconds)

    def _time(self, event: BusyRadio) -> float:
        return event.median_s * math.exp(event.sigma * self._random.gauss(0.0, 1.0))

    def _hang(self, *, hung: bool) -> None:
        self._run.robot.hung = hung
        self.on_lost("agent", lost=hung)

    def _stall(self, *, stalled: bool) -> None:
        lidar = self._run.robot.hardware.lidar
        assert isinstance(lidar, StallingLidar), "the emulator of this lidar never falls silent"
        lidar.stalled = stalled
        self.on_lost("lidar", lost=stalled)

    def _freeze(self, turns: int) -> None:
        lidar = self._run.robot.hardware.lidar
        assert isinstance(lidar, StallingLidar), "the emulator of this lidar never falls silent"
        lidar.frozen, lidar.frozen_revolutions = turns > 0, max(turns, 1)
        if turns <= 1:
            self.on_lost("new turns", lost=turns > 0)

    def _blind(self, sector: tuple[float, float] | None) -> None:
        self._run.world.no_return_rad = sector

    def _disturb(self, event: BadLine, *, begins: bool) -> None:
        hardware = self._run.robot.hardware
        line = hardware.base_line if event.device == "base" else hardware.lidar_line
        line.lost, line.flipped = (event.lost, event.flipped) if begins else (0.0, 0.0)
        line.stalled = event.stalled and begins
        if event.stalled:
            self.on_lost(event.device, lost=begins)

    def _start_agent(self) -> None:
        self._run.robot.start_again()
        self.on_lost("agent", lost=False)

    def _set_clock(self, event: ClockChange) -> None:
        clock = self._run.robot.clock if event.computer == "robot" else self._run.system.fog.clock
        clock.change(self._run.now, jump_s=event.jump_s, rate=event.rate, crystal=event.crystal)
        self._later(event.seconds, lambda: clock.change(self._run.now, crystal=event.crystal))

    def _hold(self, wheel: Literal["left", "right"], *, held: bool) -> None:
        self._run.world.held_wheels[("left", "right").index(wheel)] = held

    def _put_zone(self, zone: Zone, seconds: float) -> None:
        self._put(zone)
        self._later(seconds, partial(self._put, msgspec.structs.replace(zone, enabled=False, version=2)))

    def _put(self, zone: Zone) -> None:
        """Draw a zone: where nobody answers, an operator tries again."""
        if self._waits_for_map(zone):
            self._repeated.append(partial(self._waits_for_map, zone))

    def _waits_for_map(self, zone: Zone) -> bool:
        fog = self._run.system.fog
        if not fog.map.alive:
            return True
        fog.put_zone(zone, moment(self._run.now))
        self.on_acknowledged(zone)
        return False

    def _replace_node(self, name: Id, replaced: Callable[[SensorNode], list[SensorNode]], seconds: float) -> None:
        """Let others take the place of a node; `seconds` later it is back."""
        fog = self._run.system.fog
        before = [node for node in fog.nodes if node.node.id == name]
        kept = [node for node in fog.nodes if node.node.id != name]
        fog.nodes = [*kept, *(other for node in before for other in replaced(node))]
        self._later(seconds, partial(self._restore_node, name, before))

    def _restore_node(self, name: Id, before: list[SensorNode]) -> None:
        fog = self._run.system.fog
        fog.nodes = [*(node for node in fog.nodes if node.node.id != name), *before]
        for node in before:
            node.on_connected()

    def _start_again(self, process: FogProcessName) -> None:
        self._run.system.fog.start_again(process, moment(self._run.now))
        self.on_lost(process, lost=False)

    def _gap(self, seconds: float, by: tuple[int, int]) -> None:
        """Begin a gap of messages (1) to and from the robot; its end ends no other one."""
        self._gaps = self._gaps[0] + by[0], self._gaps[1] + by[1]
        link = self._run.robot.process.link
        link.hears, link.is_heard = self._gaps[0] == 0, self._gaps[1] == 0
        self.on_lost("fog", lost=not link.hears)
        if seconds:
            self._later(seconds, partial(self._gap, 0.0, (-by[0], -by[1])))

    def _delay(self, seconds: float) -> None:
        self._run.robot.process.link.delay_s = seconds

    def _later(self, seconds: float, action: Callable[[], object]) -> None:
        if seconds > 0.0:
            self._ends.append((self.elapsed + seconds, action))


Fault = Literal["stuck", "flapping", "lies-clear", "lies-blocked"]
FLAP_S: Final = 1.0
"""How long a flapping node says the same."""
_NEAR_M: Final = 0.6
_MARGIN_M: Final = 0.1


class _ChangedNode:
    """A node whose readings are changed on their way."""

    def __init__(self, healthy: SensorNode) -> None:
        self.node = healthy.node
        self._healthy = healthy

    def configure(self, config: NodeConfig) -> bool:
        """Apply a configuration."""
        return self._healthy.configure(config)

    def on_connected(self) -> None:
        """Publish as after a change."""
        self._healthy.on_connected()

    def command(self, text: str) -> str | None:
        """Begin what a command asks for; return None, or why not."""
        return self._healthy.command(text)

    def take_calibration(self) -> NodeCalibration | None:
        """Return the calibration that has ended since the last call, if one has."""
        return self._healthy.take_calibration()


class SlewedNodeSim(_ChangedNode):
    """A node whose clock gains `rate` seconds a second from now on."""

    def __init__(self, healthy: SensorNode, rate: float) -> None:
        super().__init__(healthy)
        self._rate = rate
        self._begun_ms: int | None = None

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Run the node up to `now` (s); return what it reports."""
        return [self._report(reading) for reading in self._healthy.poll(world, now)]

    def _report(self, reading: NodeReading) -> NodeReading:
        self._begun_ms = reading.uptime_ms if self._begun_ms is None else self._begun_ms
        shown = self._begun_ms + round((reading.uptime_ms - self._begun_ms) * (1.0 + self._rate))
        return msgspec.structs.replace(reading, uptime_ms=shown)


class LateNodeSim(_ChangedNode):
    """A node whose readings take a time (s) on their way, which `delay` draws for each; none overtakes another."""

    def __init__(self, healthy: SensorNode, delay: Callable[[], float]) -> None:
        super().__init__(healthy)
        self._delay = delay
        self._under_way: deque[tuple[float, NodeReading]] = deque()

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Run the node up to `now` (s); return what arrives."""
        for reading in self._healthy.poll(world, now):
            last = self._under_way[-1][0] if self._under_way else now
            self._under_way.append((max(now + self._delay(), last), reading))
        arrived = []
        while self._under_way and self._under_way[0][0] <= now:
            arrived.append(self._under_way.popleft()[1])
        return arrived


class FaultyNodeSim(_ChangedNode):
    """A node with a fault: it measures as the healthy one in it does, and reports something else."""

    def __init__(self, healthy: SensorNode, fault: Fault) -> None:
        super().__init__(healthy)
        self._fault: Fault = fault
        self._shown: AreaState | None = None

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Run the node up to `now` (s); return what it reports."""
        if (state := self._state(now)) != self._shown:
            self._shown = state
            self._healthy.on_connected()  # a change of what it reports goes out as one of what it measures would
        return [self._report(reading, now) for reading in self._healthy.poll(world, now)]

    def _state(self, now: float) -> AreaState:
        match self._fault:
            case "stuck":
                return "unknown"
            case "flapping":
                return "blocked" if int(now / FLAP_S) % 2 == 0 else "clear"
            case "lies-blocked":
                return "blocked"
            case "lies-clear":
                return "clear"

    def _report(self, reading: NodeReading, now: float) -> NodeReading:
        sonars = self.node.sonars
        state = self._state(now)
        if self._fault == "stuck":
            none: list[float | None] = [None] * len(sonars)
            return msgspec.structs.replace(reading, range_m=none, status=["stuck"] * len(sonars), state=state)
        # The wall across the corridor is a little farther away than the limit.
        ranges: list[float | None] = [
            _NEAR_M if state == "blocked" else sonar.range_limit + _MARGIN_M for sonar in sonars
        ]
        return msgspec.structs.replace(reading, range_m=ranges, status=["ok"] * len(sonars), state=state)
