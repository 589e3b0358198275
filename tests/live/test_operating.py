"""The README's walk through a running demo, run as it is written."""

import json
import os
import re
import shlex
import subprocess
import time
from pathlib import Path

import programs
import pytest

pytestmark = [pytest.mark.live, pytest.mark.timeout(900)]

ROOT = Path(__file__).parents[2]
START_TIMEOUT_S = 300.0
"""Its nine processes take 20 s of a core to start: a busy machine may be ten times slower."""
COMMAND_S = 180.0
"""For a command, which loads every member: a busy machine may be ten times slower."""
BUSY_LOAD, BUSY_SPEED = 2.5, 0.4
"""Above this load of each core the demo runs more slowly, which makes the limits of the robot's processes longer: a
robot that stops because the machine delays them is none of this test's business."""


def readme_commands() -> tuple[str, list[str]]:
    """The command that starts the demo, and the commands of the second terminal, without their comments."""
    section = (ROOT / "README.md").read_text("utf-8").partition("### Talk to a running demo")[2]
    first, second = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)[:2]
    return first.strip(), [line.partition("  #")[0].strip() for line in second.splitlines()]


class Terminal:
    """A shell in the checkout whose systems are registered apart from those of other tests."""

    def __init__(self, runtime: Path, environment: dict[str, str]) -> None:
        runtime.mkdir(mode=0o700)
        # No fog node of this machine, and no other demo.
        ports = {f"FOGNAV_{name}_PORT": "1" for name in ("AGGREGATOR", "MAP", "PLANNER")}
        self.environment = {**environment, "XDG_RUNTIME_DIR": str(runtime), **ports}
        self.output: dict[str, str] = {}

    def arguments(self, command: str) -> list[str]:
        """What the command gives to `fognav`."""
        words = shlex.split(command)
        assert words[0] in ("./fognav", str(ROOT / "fognav"))
        return words[1:]

    def run(self, command: str) -> subprocess.CompletedProcess[str]:
        done = programs.run(self.arguments(command), self.environment, ROOT, COMMAND_S)
        self.output[command] = done.stdout + done.stderr
        return done

    def wait_driving(self) -> None:
        """Wait until the robot drives: a new goal stops it for a moment."""
        deadline = time.monotonic() + COMMAND_S
        command = "./fognav robot status"
        self.run(command)
        while "NORMAL" not in self.output[command]:
            assert time.monotonic() < deadline, self.output[command]
            self.run(command)


def speed() -> list[str]:
    """Return the option for the speed of a demo on a busy machine."""
    busy = os.getloadavg()[0] > BUSY_LOAD * (os.cpu_count() or 1)
    return [f"--speed={BUSY_SPEED}"] if busy else []


def wait_for(pattern: str, output: Path, demo: programs.Program) -> re.Match[str]:
    deadline = time.monotonic() + START_TIMEOUT_S
    while (found := re.search(pattern, output.read_text("utf-8"), re.MULTILINE)) is None:
        assert demo.poll() is None, output.read_text("utf-8")
        assert time.monotonic() < deadline, f"not printed in time: {pattern}\n{output.read_text()}"
        time.sleep(0.1)
    return found


SERVICES = ("map-service", "planner", "hazard-aggregator")


def test_walk_through_a_running_demo_works_as_the_readme_says(tmp_path):
    start, commands = readme_commands()
    assert len(commands) > 8
    terminal = Terminal(tmp_path / "runtime", dict(os.environ))
    printed = tmp_path / "demo.txt"
    arguments = (*terminal.arguments(start), *speed())
    demo = programs.start("fognav", terminal.environment, printed, *arguments, forks=True)
    try:
        zone = wait_for(r"^draw a zone: (.+)$", printed, demo)
        wait_for("^planner: plan 1", printed, demo)
        drawn = terminal.run(zone[1])
        assert drawn.returncode == 0, terminal.output
        for command in commands:
            if " watch " in command:
                terminal.wait_driving()
            done = terminal.run(command)
            assert done.returncode == 0, f"{command}\n{terminal.output[command]}\n{printed.read_text()}"
            if " zone add" in command:
                wait_for("^planner: plan 2", printed, demo)
            if " goal d" in command:
                wait_for("^stopped: somebody sent the robot elsewhere", printed, demo)
        override = next(command for command in commands if " override " in command)
        again = terminal.run(f"{override} --json")
        assert json.loads(again.stdout)["override"]["version"] == 2, again.stderr
        status = json.loads((terminal.run("./fognav status --json")).stdout)
        (system,) = [system for system in status["systems"] if system["kind"] == "demo"]
        assert system["site"] == "estig"
        assert set(system["connected"]) >= {f"{name}/estig" for name in SERVICES} | {"robot-agent/r1"}
        assert set(system["urls"]) >= {"map-service", "planner", "hazard-aggregator", "page"}
        assert Path(system["token_file"]).stat().st_mode & 0o777 == 0o600
        assert system["pids"]["demo"] == demo.pid
        watched = terminal.output["./fognav robot watch --seconds 3"]
        assert len(re.findall(r"^\d\d:\d\d:\d\d NORMAL", watched, re.MULTILINE)) >= 2, watched
        assert "wet floor" in terminal.output["./fognav zone list"]
        assert "mission is ended" in terminal.output["./fognav robot stop"]
        turn = terminal.run("./fognav robot turn")
        assert turn.returncode == 1
        assert "the robot knows where it is" in turn.stdout + turn.stderr
    finally:
        demo.terminate()
        assert demo.wait(60) == 1  # interrupted
    assert list((tmp_path / "runtime").rglob("*.json")) == []
    gone = terminal.run("./fognav zone list")
    assert gone.returncode == 1
    assert "no demo or fog node runs on this machine" in gone.stderr
