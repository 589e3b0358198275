"""Cache of compiled kernels: a second process compiles nothing, and processes load only the kernels that they need."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from compiler import compiled_only

from fog_kernels import warm

pytestmark = compiled_only

RUN_ALL = """
import numpy as np
from fog_contracts.costs import DEFAULT_INFLATION
from fog_kernels import warm
warm.warm()
from fog_kernels import amcl, astar, clearance, components, distance, dwa, inflation
from fog_kernels import robot
from fog_kernels import emulation, lidar, lines, raycast, tiles
raw = np.zeros((60, 60), np.uint8)
raw[0] = 254
shut = raw.copy()
shut.setflags(write=False)
table = inflation.inflation_table(0.05, DEFAULT_INFLATION)
for source in (raw, shut):
    cost = inflation.inflate(source, table)
    inflation.inflate_window(source, table, 3, 3, 4, 4, cost)
    distance.squared_distance_capped(source, 5)
    field = distance.likelihood_field(source == 254, 0.05)
    planner = astar.Planner(60, 60)
    patterns = tiles.TilePatterns(10**6)
    guide = planner.goal_field(cost, (50, 50), patterns)
    patterns.compacted([guide]), planner.goal_field(cost, (9, 9), tiles.TilePatterns(0), 2).coarser()
    cells = planner.plan(cost, (20, 20), (50, 50), field=guide).cells
    planner.plan(cost, (np.int64(20), np.int32(20)), (40, 50), max_expansions=10)
    planner.shortcut(cost, cells)
    planner.exit_path(cost, cost, (20, 20)), astar.nearest_traversable(cost, (0, 0), 20)
    found = components.Components(cost)
    found.nearest(found.of(20, 20), (0, 0)), found.labels(0, 0, 5, 5), found.both_in(np.ones((2, 4), np.int32), 0, 0)
    lines.line_cost(cost, 20, 20, 30, 30)
    lines.cost_from(cost, np.full((2, 2), 20.0), np.zeros(2), 0.0, (0.0, 0.0, 1.0))
    lines.first_inside(np.zeros((2, 2)), np.zeros(2), 0.1, 0.0, (0.0, 0.0, 1.0), (0, 0), np.ones((2, 2), np.bool_))
    lines.nearest_between(np.zeros((2, 2)), np.zeros(2), 0.0, 1.0, 1.0, 1.0)
    lines.nearest_on(np.zeros((2, 2)), np.zeros(2), 0, 1, 1.0, 1.0)
    nodes = lidar.decode_nodes(bytes(5) if source is raw else bytes((1, 1, 0, 0, 0)))
    lidar.batch(*lidar.in_metres(nodes.angle_q6, nodes.distance_q2), 0.0, 1.0)
    angles = emulation.node_angles(0.5, 0.1, 5)
    emulation.encode_nodes(angles.angle_q6, angles.start, np.ones(5), 0.1, 9.0)
    emulation.disturb(np.ones(5), np.ones(5), np.ones(5), sigma=0.1, share=0.0, dropout=0.0, low=0.0, high=9.0)
    lidar_beams, drawn = emulation.Beams(*np.ones((3, 5))), emulation.Drawn(*np.ones((2, 5)), np.ones((3, 5)))
    errors = emulation.RecordedErrors(np.ones((1, 2)), np.ones((1, 2)), 0.1, 4.0, 0.1, 0.1, 9.0)
    emulation.disturb_as_recorded(np.ones(5), lidar_beams, drawn, errors, (0, 0), np.ones((0, 4)), np.ones((0, 2)))
    emulation.set_in_sectors(np.ones(5), np.ones(5), np.ones((1, 2)), 0.1)
    emulation.edge_ranges(np.ones((3, 4)), np.ones(3), 0.0, 0.0, np.ones(5), np.zeros(5))
    emulation.nearest_occupied(source, (3, 3), 2, 0.05, (0.0, 0.0), (0.2, 0.2))
    lines.leaves(np.zeros((2, 2)), np.ones((2, 2)), 0.5, 0.1)
    limits = dwa.DwaLimits(axle=0.235, wheel_max=0.5)
    shape, how = robot.cover([(0.2, -0.1), (0.2, 0.1), (-0.2, 0.1), (-0.2, -0.1)]), robot.DEFAULT_SETTINGS
    around = clearance.clearance(cost, 0.05, 0, 0, [(1, 2)], 1, 1, shape, DEFAULT_INFLATION, limits, how)
    dwa.dwa(0, 0, 1, 1, np.float32(0), around, [(1, 1), (2, 1)], 2, 1, None, shape, limits)
    ranges = raycast.cast(source, 0.05, 0, 0, 1, 1, [0, -1.5], 5)
    state = amcl.rng_state(1)
    x, y, theta = (np.ones(5, np.float32) for _ in range(3))
    weights = np.full(5, 0.2)
    amcl.motion_update(x, y, theta, 0, 1, 0, (1, 1, 1, 1), state)
    amcl.score_poses(x, y, theta, field, 0.05, 0, 0, [0, 1], [1, 1])
    amcl.estimate(*amcl.resample(x, y, theta, weights, 2, 5, 0.05, state))
print(warm.cache_misses())
"""


def python(*arguments: str) -> str:
    return subprocess.run(
        [sys.executable, *arguments], check=True, capture_output=True, text=True, timeout=170
    ).stdout.strip()


@pytest.mark.drive
def test_process_that_calls_every_kernel_compiles_nothing_after_warming() -> None:
    python("-m", "fog_kernels.warm")
    assert python("-c", RUN_ALL) == "0"


def test_cache_misses_are_counted() -> None:
    """Without a cache the counter that is zero in the test above is not zero."""
    code = (
        "import tempfile, os; os.environ['NUMBA_CACHE_DIR'] = tempfile.mkdtemp()\n"
        "from fog_kernels import warm, raycast\nprint(warm.cache_misses())"
    )
    assert int(python("-c", code)) >= 1


IMPORT_EACH = """
import importlib, os, sys, numba  # numba once, the kernels in a process for each module
for module in sys.argv[1:]:
    if os.fork() == 0:
        importlib.import_module("fog_kernels." + module)
        print(module, *(name.removeprefix("fog_kernels.") for name in sys.modules if name.startswith("fog_kernels.")))
        sys.stdout.flush()
        os._exit(0)
    os.wait()
"""


def test_importing_a_module_loads_no_unneeded_kernels() -> None:
    unneeded = {
        "dwa": {"astar", "inflation", "amcl", "raycast", "lidar", "distance"},
        "amcl": {"astar", "inflation", "dwa", "raycast", "distance"},
        "distance": {"astar", "inflation", "dwa", "raycast", "amcl"},
        "lidar": {"astar", "inflation", "dwa", "raycast", "amcl", "distance", "lines"},
        "astar": {"inflation", "dwa", "raycast", "amcl", "lidar", "distance"},
    }
    lines = [line.split() for line in python("-c", IMPORT_EACH, *unneeded).splitlines()]
    loaded = {module: set(names) for module, *names in lines}
    assert [module for module in unneeded if module not in loaded[module]] == []
    assert [(module, others & loaded[module]) for module, others in unneeded.items() if others & loaded[module]] == []


def test_unknown_profile_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match="robot"):
        warm.warm("toaster")


@pytest.mark.drive
def test_progress_reports_every_kernel_once_by_name(tmp_path):
    cold = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "fog_kernels.warm", "sim"]
    names = [f"{module}.{name}" for module in warm.PROFILES["sim"] for name in warm.kernels(module)]
    done = subprocess.run(command, env=cold, capture_output=True, text=True, check=True)
    lines = [line for line in done.stdout.splitlines() if "kernels ready: " in line]
    assert [line.rpartition(" ")[2] for line in lines if "." in line] == names
    assert lines[-1].startswith(f"{len(names)} of {len(names)} ")
    again = subprocess.run(command, env=cold, capture_output=True, text=True, check=True)
    lines = [line for line in again.stdout.splitlines() if "kernels ready: " in line]
    assert [line.rpartition(" ")[2] for line in lines] == list(warm.PROFILES["sim"])
    assert " 0 compiled now" in again.stdout


def test_kernels_of_an_unknown_module_are_refused():
    with pytest.raises(ValueError, match=r"no module fog_kernels\.nothing"):
        warm.kernels("nothing")
