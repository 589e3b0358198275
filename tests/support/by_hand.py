"""A simulated robot without fog, site and map, run by its real processes, and who watches it drive by hand."""

from __future__ import annotations

import os
import shutil
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import programs

from robot_agent.agent.recording.input_log import BaseReceived, Published
from robot_agent.local_client import LocalRobot

if TYPE_CHECKING:
    import subprocess

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
SETTINGS = '[base]\ndriver = "roomba600"\n[lidar]\ndriver = "rplidar-a1"\n[body]\nradius_m = 0.17\n'


@contextmanager
def robot_without_fog(folder: Path, truth: str = SETTINGS, **agents: str):
    """Run simulator, watchdog and agent; yields the agent's socket.

    truth: how the simulated robot really is, which its settings need not say. agents: further variables of the agent.
    """
    wires = folder / "sim"
    wires.mkdir()
    (folder / "robot.toml").write_text(SETTINGS, "utf-8")
    (folder / "truth.toml").write_text(truth, "utf-8")
    common = {
        **os.environ,
        "FOGNAV_ROBOT_FILE": str(folder / "robot.toml"),
        "FOGNAV_ROBOT": "r1",
        "FOGNAV_BASE_PORT": str(wires / "base"),
        "FOGNAV_LIDAR_PORT": str(wires / "lidar"),
        "FOGNAV_GUARDIAN_SOCKET": str(folder / "guardian.sock"),
        "FOGNAV_ZENOH_CONNECT": "tcp/127.0.0.1:9",
        "FOGNAV_MQTT_URL": "mqtt://127.0.0.1:9",
    }
    simulator = {"FOGNAV_SITE_DIR": str(ESTIG), "FOGNAV_RUN_DIR": str(wires), "FOGNAV_NODES": "model"}
    simulator["FOGNAV_ROBOT_FILE"] = str(folder / "truth.toml")
    simulator["FOGNAV_TRUTH_LOG"] = str(folder / "truth.jsonl")
    with ExitStack() as stack:
        for module, own in (
            ("fognav_sim", simulator),
            ("robot_agent.guardian.watchdog", {}),
            ("robot_agent", {"FOGNAV_FOG": "false", **agents}),
        ):
            data = folder / f"{module}.data"
            data.mkdir()
            log = folder / f"{module}.log"
            program = programs.start(module, {**common, **own, "FOGNAV_DATA_DIR": str(data)}, log)
            stack.callback(program.wait, 10.0)
            stack.callback(program.terminate)
            if module == "fognav_sim":
                wait_for((wires / "lidar").exists, "the simulator's devices")
        socket = folder / "agent.sock"
        wait_for(socket.exists, "the agent's socket")
        yield socket


def wait_for(condition, expected: str, seconds: float = 60.0):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if value := condition():
            return value
        time.sleep(0.02)
    raise AssertionError(f"not within {seconds:g} s: {expected}")


class Watcher:
    """Knows the robot's mode and how far each wheel has rolled."""

    def __init__(self, path: Path) -> None:
        self.mode = ""
        self.wheels = (0.0, 0.0)
        self._robot = LocalRobot(path)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        wait_for(lambda: self.mode and self.wheels != (0.0, 0.0), "the robot speaks")
        return self

    def __exit__(self, *_):
        self._ends.set()
        self._thread.join()
        self._robot.close()

    def _run(self) -> None:
        while not self._ends.is_set():
            for entry in self._robot.entries(0.1):
                if isinstance(entry, Published):
                    self.mode = entry.message["mode"]
                elif isinstance(entry, BaseReceived):
                    self.wheels = (entry.feedback.odometry.left_m, entry.feedback.odometry.right_m)
                if self._ends.is_set():
                    return

    def rolled(self, seconds: float) -> tuple[float, float]:
        """Return how far (m) the wheels roll during the next seconds."""
        before = self.wheels
        time.sleep(seconds)
        return self.wheels[0] - before[0], self.wheels[1] - before[1]


@contextmanager
def ended(process: subprocess.Popen):
    with process:
        try:
            yield
        finally:
            process.terminate()
            process.wait(10.0)


def chromium(playwright):
    """Start this computer's Chromium."""
    return playwright.chromium.launch(
        executable_path=shutil.which("chromium"),
        args=["--no-sandbox", "--disable-gpu", "--disable-background-networking"],
    )
