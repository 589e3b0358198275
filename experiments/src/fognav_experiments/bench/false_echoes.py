"""What false echoes cost: how long a warning takes, and how often there is one without a cause. In simulated time.

All sonars of a site hear what is not there, in a share of their measurements. The nodes run the firmware's code, and
are calibrated in that first; the aggregator's core decides by what they learned.
"""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.site import learned_share
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.parts import PartError
from fognav.output import FailedError, WrongUseError
from fognav_sim.barrier import BarrierError, barrier_across
from fognav_sim.live import StillFloor
from fognav_sim.nodes import make_nodes
from fognav_sim.world import World
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.messages import NodeCalibration, SimObstacle
    from fog_contracts.site import NodeSite, Sonar
    from fog_runtime.configuration.site import LoadedSite

_NEAREST_M: Final = 0.02
_STEP_S: Final = 0.01
_TICK_STEPS: Final = 10
_CALIBRATED_AFTER_S: Final = 600.0
"""Simulated seconds; a node with eight sonars needs less than 150."""
_CLEAR_AFTER_S: Final = 600.0
_MISSED_AFTER_S: Final = 10.0
_TRIES: Final = 20
"""So many obstacles in a row may come just when their area is blocked by false echoes."""
_PHASE_S: Final = 0.3
"""Obstacles come at any moment of the nodes' cycle, which is shorter than this."""


class Asked(NamedTuple):
    """What to measure: the share of false echoes, hours without an obstacle, obstacles, and the seed of all chance."""

    share: float
    hours: float
    warnings: int
    seed: int


class FalseEchoes:
    """Invents echoes from nearer than a sonar's limit, in a share of all measurements."""

    def __init__(self, share: float, seed: int) -> None:
        self._share = share
        self._random = random.Random(seed)  # noqa: S311  # repeatable, no secret

    def heard(self, measured: float | None, sonar: Sonar) -> float | None:
        """Return what a sonar measures (m) that should have measured this."""
        if self._random.random() < self._share:
            return self._random.uniform(_NEAREST_M, sonar.range_limit)
        return measured


class _NoisyWorld(World):
    """A world whose sonars hear what is not there; it notes when one first met something that is there."""

    false_echoes = FalseEchoes(0.0, 0)
    now = 0.0
    echo: float | None = None

    def sonar(self, node: NodeSite, index: int) -> float | None:
        """Return what a sonar measures (m)."""
        measured = super().sonar(node, index)
        sonar = node.sonars[index]
        if self.echo is None and measured is not None and measured < sonar.range_limit:
            self.echo = self.now
        return self.false_echoes.heard(measured, sonar)

    def forget(self) -> None:
        """Wait for the next echo."""
        self.echo = None


def calibrated(node: NodeSite, world: World) -> NodeSite:
    """Return a node with the rates of false echoes that its firmware counts in this world.

    Raises `FailedError` when it can't calibrate with so many.
    """
    (sensor,) = make_nodes([node], 1, 0.0, "firmware")
    problem = sensor.command(ch.CALIBRATE)
    for step in range(1, round(_CALIBRATED_AFTER_S / _STEP_S)):
        if problem is not None:
            break
        sensor.poll(world, step * _STEP_S)
        if (learned := sensor.take_calibration()) is not None:
            return _with_rates(node, learned)
    raise FailedError(f"node {node.id} did not calibrate: {problem or 'it did not end'}")


def _with_rates(node: NodeSite, learned: NodeCalibration) -> NodeSite:
    sonars = []
    for number, (sonar, result) in enumerate(zip(node.sonars, learned.result, strict=True)):
        if not learned.samples[number]:
            raise FailedError(
                f"sonar {number + 1} of node {node.id} can't be calibrated ({result}): choose fewer --false-echoes"
            )
        rate = learned_share(learned.false_echoes[number], learned.samples[number])
        sonars.append(structs.replace(sonar, false_echo_rate=round(rate, 4)))
    return structs.replace(node, sonars=sonars)


class _Fog:
    """The site's nodes, and the aggregator's areas, of which it knows which are blocked."""

    def __init__(self, loaded: LoadedSite, world: _NoisyWorld, nodes: Sequence[NodeSite], rule: str) -> None:
        site = loaded.site
        self.world = world
        self._nodes = make_nodes(nodes, 1, 0.0, "firmware", apart=0.025)
        self._fusion = AreaFusion(site.definitions(), nodes, 1, registry=find_rule, default_rule=rule)
        self._steps = 0
        self.states: dict[str, str] = {}
        self.alarms = 0
        """How often an area has become blocked."""

    @property
    def now(self) -> float:
        return self._steps * _STEP_S

    def step(self) -> None:
        self._steps += 1
        now = self.world.now = self.now
        changed = [
            hazard
            for node in self._nodes
            for reading in node.poll(self.world, now)
            for hazard in self._fusion.on_reading(node.node.id, reading, now, now)
        ]
        if self._steps % _TICK_STEPS == 0:
            changed += self._fusion.tick(now, now)
        for hazard in changed:
            self.alarms += hazard.state == "blocked" != self.states.get(hazard.area)
            self.states[hazard.area] = hazard.state

    def run(self, seconds: float) -> None:
        until = self.now + seconds
        while self.now < until:
            self.step()

    def run_until(self, condition: Callable[[], bool], within_s: float) -> bool:
        """Run until the condition holds; return whether it did in time."""
        until = self.now + within_s
        while not condition():
            if self.now >= until:
                return False
            self.step()
        return True


def measure(loaded: LoadedSite, rule: str, asked: Asked) -> dict[str, Any]:
    """Return the warning times (ms) and false alarms of a debounce rule.

    Raises `WrongUseError` for an unknown rule, and `FailedError`.
    """
    if not loaded.site.nodes:
        raise FailedError(f"site {loaded.site.id} has no nodes: add one (fognav node add)")
    try:
        find_rule(rule)
    except PartError as error:
        raise WrongUseError(f"--rule {rule}: {error}") from error
    world = StillFloor(loaded, (), SystemClock(), world=_NoisyWorld).world
    assert isinstance(world, _NoisyWorld)
    world.false_echoes = FalseEchoes(asked.share, asked.seed)
    nodes = [calibrated(node, world) for node in loaded.site.nodes]
    fog = _Fog(loaded, world, nodes, rule)
    watched = sorted({node.area for node in nodes})
    _await_clear(fog, watched)
    before = fog.alarms
    fog.run(3600.0 * asked.hours)
    alarms = fog.alarms - before
    chance = random.Random(asked.seed)  # noqa: S311  # repeatable, no secret
    times = [
        _warning(fog, watched, barrier, chance)
        for barrier in (_barrier(loaded, watched, number, asked.seed + number) for number in range(asked.warnings))
    ]
    heard = [each for each in times if each is not None]
    rates = [sonar.false_echo_rate for node in nodes for sonar in node.sonars if sonar.false_echo_rate is not None]
    row: dict[str, Any] = {
        "rule": rule,
        "false_echoes_percent": round(100.0 * asked.share, 3),
        "learned_percent_max": round(100.0 * max(rates), 2),
        "nodes": len(nodes),
        "hours": asked.hours,
        "false_alarms": alarms,
        "false_alarms_per_h": round(alarms / asked.hours, 2),
        "warnings": len(times),
        "missed": len(times) - len(heard),
    }
    for label, p in (("p50", 50), ("p99", 99), ("max", 100)):
        row[f"echo_to_confirmed_{label}_ms"] = round(1000.0 * float(np.percentile(heard, p))) if heard else None
    return row


def _barrier(loaded: LoadedSite, watched: Sequence[str], number: int, seed: int) -> tuple[str, SimObstacle]:
    name = watched[number % len(watched)]
    area = next(each for each in loaded.site.areas if each.id == name)
    try:
        return name, barrier_across(area, loaded.site, loaded.map, seed)
    except BarrierError as error:
        raise FailedError(str(error)) from error


def _warning(fog: _Fog, watched: Sequence[str], placed: tuple[str, SimObstacle], chance: random.Random) -> float | None:
    """Return the time (s) from an obstacle's first echo until its area is blocked; None if that is missed.

    An area that a false alarm has blocked before that echo warns of nothing: then the obstacle is placed again.
    Raises `FailedError` if that goes on.
    """
    area, barrier = placed
    world = fog.world

    def blocked() -> bool:
        return fog.states[area] == "blocked"

    for _ in range(_TRIES):
        _await_clear(fog, watched)
        fog.run(chance.uniform(0.0, _PHASE_S))
        world.forget()
        world.place(barrier)
        happened = fog.run_until(lambda: world.echo is not None or blocked(), _MISSED_AFTER_S)
        echo = world.echo
        confirmed = echo is not None and fog.run_until(blocked, _MISSED_AFTER_S)
        world.remove(barrier.id)
        if echo is not None:
            return fog.now - echo if confirmed else None
        if not happened:
            return None
    raise FailedError(f"area {area} was blocked by a false alarm before each of {_TRIES}: choose fewer --false-echoes")


def _await_clear(fog: _Fog, watched: Sequence[str]) -> None:
    if not fog.run_until(lambda: all(fog.states.get(area) == "clear" for area in watched), _CLEAR_AFTER_S):
        states = ", ".join(f"{area} {fog.states.get(area)}" for area in watched if fog.states.get(area) != "clear")
        raise FailedError(f"not all areas became clear within 10 minutes ({states}): choose fewer --false-echoes")
