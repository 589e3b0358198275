"""The DWA kernel against the reference implementation: the same arcs, scores and choice."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from compiler import compiled_only, examples
from dwa_reference import Scene, decide
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fog_contracts.costs import DEFAULT_INFLATION
from fog_kernels.clearance import Clearance, clearance
from fog_kernels.dwa import DwaLimits, DwaResult, DwaSettings, dwa
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.robot import cover

if TYPE_CHECKING:
    from numpy.typing import NDArray

RESOLUTION = 0.05
SIDE = 60
INFLATED = inflation_table(RESOLUTION, DEFAULT_INFLATION)
ORIGIN = (-1.0, 2.0)


def costmap(rng: np.random.Generator, kind: str) -> NDArray[np.uint8]:
    """Clutter with its inflation, noise of all costs, or patches (15 cm) of free, graded and inscribed cells."""
    if kind == "noise":
        return rng.integers(0, 254, (SIDE, SIDE)).astype(np.uint8)
    if kind == "patches":
        patches = rng.choice(np.array([0, 100, 253], np.uint8), (SIDE // 3, SIDE // 3))
        return np.ascontiguousarray(patches.repeat(3, axis=0).repeat(3, axis=1))
    raw = np.zeros((SIDE, SIDE), np.uint8)
    things = rng.integers(0, SIDE, (int(rng.integers(0, 30)), 2))
    raw[things[:, 0], things[:, 1]] = rng.choice(np.array([254, 255], np.uint8), len(things))
    return inflate(raw, INFLATED)


def route(rng: np.random.Generator, kind: str) -> NDArray[np.float64]:
    """A path in the frame of the window: far corners, there and back, points on a line, points on a curve, or none."""
    if kind == "corners":
        turns = np.cumsum(rng.uniform(-1.6, 1.6, 6))
        steps = rng.uniform(0.3, 1.0, 6)[:, None] * np.column_stack((np.cos(turns), np.sin(turns)))
        return rng.uniform(0.5, 2.5, 2) + np.cumsum(steps, axis=0)
    if kind == "hairpin":
        # Wider than 25 cm: nearer points may be merged.
        turn, gap = np.array([(0.0, 1.0), (-1.0, 0.0)]), rng.uniform(0.26, 0.4)
        there = rng.uniform(0.6, 1.2) * np.array([math.cos(gap * 40), math.sin(gap * 40)])
        back = gap / np.hypot(*there) * turn @ there
        return rng.uniform(1.0, 2.0, 2) + np.array([0.0 * there, there, there + back, back])
    if kind == "line":
        begin, end = rng.uniform(0.2, 2.8, (2, 2))
        return begin + np.linspace(0.0, 1.0, 40)[:, None] * (end - begin)
    if kind == "curve":
        angles = rng.uniform(-3.0, 3.0) + np.linspace(0.0, rng.uniform(0.5, 1.6), 60)
        return rng.uniform(1.0, 2.0, 2) + rng.uniform(0.8, 1.5) * np.column_stack((np.cos(angles), np.sin(angles)))
    return np.zeros((0, 2))


ROUND = cover([(0.17 * math.cos(a), 0.17 * math.sin(a)) for a in np.arange(64) * math.tau / 64])
LONG = cover([(0.25, -0.15), (0.25, 0.15), (-0.12, 0.15), (-0.12, -0.15)])


@dataclass(frozen=True)
class Draft:
    """A scene whose distances are not computed yet: they depend on limits and settings."""

    scene: Scene
    costmap: NDArray[np.uint8]
    points: NDArray[np.float64]

    def scene_for(self, bounds: DwaLimits, chosen: DwaSettings) -> Scene:
        x, y, _ = self.scene.pose
        return replace(
            self.scene,
            around=clearance(
                self.costmap, RESOLUTION, *ORIGIN, self.points, x, y, self.scene.body, DEFAULT_INFLATION, bounds, chosen
            ),
        )


NOTHING = Clearance(np.zeros((2, 2), np.uint8), np.ones((2, 2), np.float32), RESOLUTION, *ORIGIN)


@st.composite
def scenes(draw: st.DrawFn, routes: list[str]) -> Draft:
    """Random decisions; numbers come from a seeded generator, so that none lies on a cell's border."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    path = route(rng, draw(st.sampled_from(routes)))
    goal = path[-1] if len(path) else rng.uniform(0.2, 2.8, 2)
    where = draw(st.sampled_from(["near the path", "at the goal", "anywhere"]))
    if where == "anywhere" or not len(path):
        here = rng.uniform(-0.1, 3.1, 2)
    elif where == "at the goal":
        here = goal + rng.normal(0.0, 0.06, 2)
    else:
        here = path[rng.integers(0, len(path))] + rng.normal(0.0, 0.1, 2)
    theta = rng.uniform(-7.0, 7.0)
    if len(path) > 1 and draw(st.booleans()):  # otherwise nearly every decision would be to turn in place
        nearest = min(int(np.hypot(*(path - here).T).argmin()), len(path) - 2)
        along = path[nearest + 1] - path[nearest]
        theta = math.atan2(along[1], along[0]) + rng.normal(0.0, 0.4)
    seen = here + rng.uniform(-1.0, 1.0, (draw(st.sampled_from([0, 1, 6])), 2))
    scene = Scene(
        v=rng.uniform(-0.05, 0.5),
        w=rng.uniform(-3.5, 3.5),
        pose=(ORIGIN[0] + here[0], ORIGIN[1] + here[1], theta),
        around=NOTHING,
        body=draw(st.sampled_from([ROUND, LONG])),
        path=path + ORIGIN,
        goal=(float(ORIGIN[0] + goal[0]), float(ORIGIN[1] + goal[1])),
        goal_theta=draw(st.sampled_from([None, rng.uniform(-4.0, 4.0)])),
    )
    kind = draw(st.sampled_from(["clutter", "clutter", "noise", "patches"]))
    return Draft(scene, costmap(rng, kind), seen + ORIGIN)


ROOMBA = DwaLimits(axle=0.235, wheel_max=0.5)
limits = st.builds(
    DwaLimits,
    axle=st.just(ROOMBA.axle),
    v_max=st.sampled_from([0.0, 0.08, 0.3, 1.0]),
    w_max=st.sampled_from([0.7, 2.75]),
    acc_v=st.sampled_from([0.1, 2.5]),
    acc_w=st.sampled_from([1.0, 3.2]),
    wheel_max=st.sampled_from([0.22, 0.5]),
    acc_lateral=st.sampled_from([0.1, 0.4]),
)
parameters = st.builds(
    DwaSettings,
    n_v=st.integers(2, 7),
    n_w=st.integers(3, 9),
    sim_time=st.sampled_from([0.55, 1.5]),
    dt=st.sampled_from([0.1, 0.17]),
    w_path=st.floats(0.0, 3.0),
    w_goal=st.floats(0.0, 3.0),
    w_heading=st.floats(0.0, 1.0),
    w_cost=st.floats(0.0, 1.0),
    w_turn=st.floats(0.0, 0.1),
    lookahead=st.sampled_from([0.2, 0.3]),
    turn_in_place=st.sampled_from([0.5, 1.0, 4.0]),
    escape_v=st.sampled_from([0.0, 0.1]),
)


def choose(scene: Scene, bounds: DwaLimits, chosen: DwaSettings) -> DwaResult:
    return dwa(
        scene.v, scene.w, *scene.pose, scene.around, scene.path, *scene.goal, scene.goal_theta, scene.body, bounds,
        chosen,
    )  # fmt: skip


@settings(max_examples=examples(300), deadline=None)
@given(scenes(["corners", "hairpin", "line", "none"]), limits, parameters)
@pytest.mark.drive
def test_kernel_chooses_the_same_arc_as_the_reference(draft: Draft, bounds: DwaLimits, weights: DwaSettings) -> None:
    scene = draft.scene_for(bounds, weights)
    result = choose(scene, bounds, weights)
    arcs = decide(scene, bounds, weights)
    if arcs is None:
        assert result == (0.0, 0.0, 0.0, 1)
        return
    assert result.n_admissible == len(arcs)
    if not arcs:
        assert result == (0.0, 0.0, -math.inf, 0)
        return
    assert result.score == pytest.approx(max(arc.score for arc in arcs), abs=1e-6)
    same = min(arcs, key=lambda arc: abs(arc.v - result.v) + abs(arc.w - result.w))
    assert (same.v, same.w) == pytest.approx((result.v, result.w), abs=1e-9)
    assert same.score == pytest.approx(result.score, abs=1e-6)


@settings(max_examples=examples(60), deadline=None)
@given(scenes(["curve"]))
def test_merging_points_of_a_curve_changes_scores_only_slightly(draft: Draft) -> None:
    """Points within a centimetre of a straight line are merged: a score moves by centimetres of path.

    On free floor, near the path, and never turning in place: elsewhere centimetres decide, and rightly so, at a
    threshold, beside a wall, or as near to one part of the curve as to another. A curve of chords is a few per cent
    shorter, and so is what is left of the route.
    """
    assume(np.hypot(*(draft.scene.path - draft.scene.pose[:2]).T).min() < 0.2)
    weights = DwaSettings(n_v=5, n_w=7, turn_in_place=4.0)
    free = replace(draft, costmap=np.zeros_like(draft.costmap), points=np.zeros((0, 2)))
    scene = free.scene_for(ROOMBA, weights)
    result = choose(scene, ROOMBA, weights)
    arcs = decide(scene, ROOMBA, weights)
    if arcs and result != (0.0, 0.0, 0.0, 1):
        assert result.score == pytest.approx(max(arc.score for arc in arcs), abs=0.25, rel=0.05)


@compiled_only
def test_generated_scenes_cover_all_kinds_of_decisions() -> None:
    """The comparison covers goals reached, no admissible arc, turning in place, driving and escaping."""
    kinds = set()

    @settings(max_examples=examples(150), deadline=None, database=None, derandomize=True)
    @given(scenes(["corners", "hairpin", "line", "none"]))
    def collect(draft: Draft) -> None:
        weights = DwaSettings(n_v=5, n_w=7)
        scene = draft.scene_for(ROOMBA, weights)
        result = choose(scene, ROOMBA, weights)
        if result.n_admissible == 0:
            kinds.add("nothing is free")
        elif result == (0.0, 0.0, 0.0, 1):
            kinds.add("reached")
        elif scene.clearance(*scene.pose, ROOMBA, weights) < weights.padding:
            kinds.add("escaping")
        else:
            kinds.add("driving" if result.v > 0.0 else "turning")

    collect()
    assert kinds == {"nothing is free", "reached", "escaping", "driving", "turning"}
