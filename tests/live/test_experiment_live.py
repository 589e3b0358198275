"""A drive by real processes, and the same one in lockstep: they agree. A robot that a person guides is measured."""

from __future__ import annotations

import os
import shutil

import pytest
from driver import ESTIG, ROBOT, START, LiveSystem
from typer.testing import CliRunner

from fog_contracts.messages import Place
from fog_runtime.configuration.site import load_site
from fog_supervisor import net
from fognav.operate.fog import Fog
from fognav.operate.robot_commands import connect
from fognav.operate.systems import System
from fognav.programs import PLANNER, ROUTER
from fognav_experiments.commands.experiment import experiment_app
from fognav_experiments.comparison.drives import ExperimentSpec, RouteDraw, RouteSpec, draw
from fognav_experiments.comparison.hardware_drive import ConnectedRobot, HardwareRun
from fognav_experiments.comparison.records import Folder
from fognav_experiments.comparison.robot_metrics import SAMPLE_S
from fognav_experiments.comparison.runner import Task

pytestmark = [pytest.mark.live, pytest.mark.timeout(300)]

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
    # So far by the robot's own exporter, every two seconds.
    assert live.thread_percent["robot-agent"]["decide"] > 0.0
    assert len(live.samples) >= 0.7 * live.time_s / SAMPLE_S - 2
    assert live.cpu_percent["planner"] > 0.0, "by the account of this machine"
    result = run.invoke(experiment_app, ["report", str(out), "--site", str(site)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    text = (out / "README.md").read_text("utf-8")
    assert "1 of the drives were repeated by real processes" in text
    assert f"| {live.load:.1f} | {live.distance_m:.1f} | {lockstep.distance_m:.1f} |" in text
    assert "largest of all the robot's processes together: default" in text


class Person:
    """Presses Enter at each question, and ends the drive once the robot has driven two metres."""

    closed = False

    def __init__(self, system):
        self._system = system
        self._asked = False
        self.said = []

    def say(self, text):
        self.said.append(text)
        self._asked = self._asked or text.endswith("Then press Enter.")

    def forget(self):
        self._asked = False

    def typed(self):
        if self._asked:
            return ""
        return "e" if self._system.truth.distance > 2.0 else None


@pytest.mark.asyncio
async def test_a_guided_drive_of_a_robot_records_what_its_exporter_tells(tmp_path):
    """Records of real robots had no CPU and no memory, although the documentation promised figures 6.9 and 6.10."""
    files = Folder(tmp_path / "drives").measured("hardware")
    (x, y), site = START, load_site(ESTIG)
    drawn = RouteDraw(
        run=1, route=RouteSpec(start="west", goal="a", areas=["z2"]), seed=1, theta=0.0, area="z2", moment="under way",
        trigger_m=50.0, ends=(Place(x=x, y=y, theta=0.0), site.site.places["a"]),
    )  # fmt: skip
    async with LiveSystem(tmp_path, patience=3.0) as system:
        await system.stop_operator()
        credentials = system.stack.security.file("console")
        fog = Fog(
            System(
                name="live", kind="demo", site="estig", robots=[ROBOT], pids={"live": os.getpid()},
                urls={
                    PLANNER: f"http://{net.LOOPBACK}:{system.stack.port(PLANNER)}", ROUTER: system.stack.zenoh_endpoint
                },
                token_file=str(system.stack.token_file), credentials_file=credentials and str(credentials),
            )
        )  # fmt: skip
        person = Person(system)
        async with connect(fog, ROBOT) as connected:
            await HardwareRun(site, ConnectedRobot(fog, connected), person).run([Task(drawn, "fog")], files)
    (record,) = files.read()
    assert record.reason == "a person ended the drive", person.said
    for process in ("robot-agent", "robot-guardian", "robot-watchdog"):
        assert record.cpu_percent[process] > 0.0
        assert record.peak_mb[process] > 5.0
    assert record.thread_percent["robot-agent"]["decide"] > 0.0
    assert record.samples[0].at >= SAMPLE_S
    assert record.samples[0].cpu_percent["robot-guardian"]
