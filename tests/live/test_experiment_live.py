"""A drive of the experiment by real processes, and the same one in lockstep: they agree."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fognav_experiments.commands.experiment import experiment_app
from fognav_experiments.comparison.drives import ExperimentSpec, RouteSpec, draw
from fognav_experiments.comparison.records import Folder

pytestmark = [pytest.mark.live, pytest.mark.timeout(300)]

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
SPEC = ExperimentSpec(routes=[RouteSpec(start="west", goal="near", areas=["z1"])])
SEED = next(seed for seed in range(100) if draw(SPEC, seed, 1)[0].moment == "before")
"""The route is so short that an obstacle which appears under way would come too late."""


def test_a_robot_that_plans_for_itself_drives_live_as_it_does_in_lockstep(tmp_path):
    site, out = tmp_path / "site", tmp_path / "drives"
    shutil.copytree(ESTIG, site, ignore=shutil.ignore_patterns("__pycache__"))
    with (site / "site.toml").open("a") as file:
        file.write("[places.west]\nx = 36.0\ny = 28.4\ntheta = 3.14159\n[places.near]\nx = 31.0\ny = 28.4\n")
    (site / "experiment.toml").write_text('[[routes]]\nstart = "west"\ngoal = "near"\nareas = ["z1"]\n')
    asked = ["--site", str(site), "--out", str(out), "--seed", str(SEED), "--runs", "1", "--setups", "default"]
    run = CliRunner()
    for options in ([], ["--live"]):
        result = run.invoke(experiment_app, [*asked, *options], catch_exceptions=False)
        assert result.exit_code == 0, result.output
    (live,), (lockstep,) = Folder(out).measured("live").read(), Folder(out).drives.read()
    # Time and stops are not asserted: they are those of a machine that may have much else to do.
    assert live.success
    assert live.distance_m == pytest.approx(lockstep.distance_m, abs=1.0)
    assert live.paths == lockstep.paths
    assert live.route_areas == lockstep.route_areas
    assert live.cpu_percent["robot-agent"] > 0.0
    assert live.peak_mb["robot-agent"] > 50.0
    result = run.invoke(experiment_app, ["report", str(out), "--site", str(site)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    text = (out / "README.md").read_text("utf-8")
    assert "1 of the drives were repeated by real processes" in text
    assert f"| {live.load:.1f} | {live.distance_m:.1f} | {lockstep.distance_m:.1f} |" in text
    assert "largest of all the robot's processes together: default" in text
