"""`fognav calibrate`: from a log, or live while somebody drives; what it found, and writing it into robot.toml."""

from __future__ import annotations

import hashlib
import math
import os
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, Self

import msgspec
import numpy as np

from fog_runtime.configuration.robot_file import ROBOT_FILE, load_robot
from fog_runtime.record import Recorder, RecordError, read_entries
from fognav.output import FailedError, WrongUseError, print_answer, print_line
from fognav.robot_page import settings_file
from fognav.robot_page.recording_view import until_told
from fognav.robot_page.view import LocalRobotErrors
from robot_agent import registry
from robot_agent.agent.recording.input_log import ENTRY_OF_TOPIC, TOPIC_OF_ENTRY, BaseReceived, ScanReceived, Started
from robot_agent.calibrated import NAMES, WANTED, Calibration, Changed, changes, differing
from robot_agent.calibration import CalibrationError, Calibrator
from robot_agent.local_client import LocalRobot

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

USED: Final = (Started, BaseReceived, ScanReceived)
"""Entries that a calibration is made of."""
RESTART: Final = "sudo systemctl restart fognav-watchdog fognav-agent"
_TOLD_S: Final = 5.0


def read(log: Path) -> Calibrator:
    """Return what a recording holds; raises `WrongUseError`."""
    calibrator = Calibrator()
    try:
        for _, topic, data in read_entries(log):
            kind = ENTRY_OF_TOPIC.get(topic)
            if kind in USED:
                calibrator.take(msgspec.json.decode(data, type=kind))
    except (OSError, RecordError, msgspec.DecodeError) as error:
        raise WrongUseError(f"{log}: {error}. Name a file that `fognav map record` wrote") from error
    return calibrator


class DriveLog:
    """The recording of a drive by which a robot is calibrated; a context manager."""

    def __init__(self, file: Path) -> None:
        """Create the file; raises `FailedError`."""
        self._file = file
        try:
            self._recorder = Recorder(file)
        except OSError as error:
            raise FailedError(f"{file} can't be made: {error.strerror}. Name another file with --out") from error

    def write(self, entry: Started | BaseReceived | ScanReceived) -> None:
        """Write an entry; raises `FailedError` when the disk takes it no more."""
        try:
            self._recorder.write_entry(TOPIC_OF_ENTRY[type(entry)], entry, time.time_ns())
        except OSError as error:
            raise FailedError(
                f"{self._file}: {error.strerror}. What was recorded until now can be read: make room, and drive again "
                f"with another --out, or calibrate by it: fognav calibrate {self._file}"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._recorder.close()
        except OSError as error:  # whatever ended the drive says more, and without its index the file can be read
            print_line(f"{self._file}: {error.strerror}: it ends without an index")


def record(socket: Path, log: Path, seconds: float | None) -> Calibrator:
    """Record while somebody drives, into `log` too, and say what must be driven yet; raises `FailedError`."""
    calibrator, said = Calibrator(), ""
    told, asked = -math.inf, None
    with (
        LocalRobotErrors(),
        LocalRobot(socket) as robot,
        DriveLog(log) as kept,
        until_told(seconds) as ends,
        ThreadPoolExecutor(1) as solver,
    ):
        print_line(
            "drive by hand (fognav teleop): turn both ways, straight ahead and back, arcs to both sides; Ctrl-C ends"
        )
        while not ends():
            for entry in robot.entries(0.2):
                if isinstance(entry, USED):
                    calibrator.take(entry)
                    kept.write(entry)
                if isinstance(entry, ScanReceived):
                    break
            # Solving takes longer than the agent's socket holds what this one does not read.
            if asked is None and time.monotonic() - told > _TOLD_S:
                asked = solver.submit(_progress, calibrator.snapshot())
            elif asked is not None and asked.done():
                told = time.monotonic()
                if (now := asked.result()) != said:
                    print_line(said := now)
                asked = None
    return calibrator


def _progress(calibrator: Calibrator) -> str:
    """Return what must be driven yet; once all is, how certain each figure is already."""
    if missing := calibrator.driven().missing():
        return "; ".join(missing)
    try:
        found = calibrator.solve()
    except CalibrationError as error:
        return str(error)
    return bars(found)


def bars(found: Calibration) -> str:
    """Return a bar for each figure, which is full once it is known well enough."""
    return "  ".join(f"{name} {'#' * min(10, int(10.0 * share)):.<10}" for name, share in known(found))


def known(found: Calibration) -> list[tuple[str, float]]:
    """Return how well each figure is known, by name: 1 is well enough."""
    shares = []
    for (name, figure), wanted in zip(found.figures.items(), WANTED, strict=True):
        half = figure.half / figure.value if name == "axle" else figure.half
        shares.append((name, wanted / max(half, 1e-9)))
    return shares


def solve(calibrator: Calibrator, robot_file: Path | None) -> tuple[Calibration, list[Changed]]:
    """Return what was found, and what it changes in a robot's settings; raises `FailedError`.

    A file with other settings than the recording's is refused: the figures are factors of those.
    """
    environ = {**os.environ, **({ROBOT_FILE: str(robot_file)} if robot_file else {})}
    try:
        found = calibrator.solve()
    except CalibrationError as error:
        raise FailedError(str(error)) from error
    robot = load_robot(environ)
    diameter = getattr(registry.options(robot)[0], "wheel_diameter_m", None)
    if diameter is None:
        raise robot.error("base.options", "this base has no `wheel_diameter_m`", "Use the figures of --json by hand")
    assert calibrator.config is not None
    others = differing(calibrator.config, robot.settings, registry.make_base(robot).drive_train)
    if robot_file is not None and others:
        raise WrongUseError(
            f"{robot_file} has another {', '.join(others)} than the recording was made with: was it calibrated by it "
            f"already? Restart watchdog and agent ({RESTART}) and record anew"
        )
    return found, changes(found, calibrator.config, robot.settings, diameter)


def refuse_disagreement(found: Calibration, recorded: Calibrator, log: Path) -> dict[str, float]:
    """Return how far the wheels were off at the end of another drive, before and now; raises `FailedError`.

    recorded: what was found by. The other drive is independent: what was found does not know it. It must be better than
    before, or within 1 % of its way, and may be made with either settings.
    """
    other = read(log)
    values = np.array([figure.value for figure in found.figures.values()])
    try:
        scale, shift, remounted = _between_settings(recorded, other)
        mirrored = found.mirrored != remounted
        before, _, way = other.end_error(scale * recorded.start + shift, mirrored=mirrored)
        now, turned, _ = other.end_error(scale * values + shift, mirrored=mirrored)
    except CalibrationError as error:
        raise FailedError(f"{log}: {error}") from error
    figures = {
        "end_error_before_m": round(before, 4),
        "end_error_m": round(now, 4),
        "end_turn_deg": round(math.degrees(turned), 2),
        "way_m": round(way, 2),
    }
    if now > before and now > 0.01 * way:
        raise FailedError(
            f"{log} contradicts it: at its end the wheels were {before:.3f} m off before, {now:.3f} m now"
        )
    return figures


def _between_settings(first: Calibrator, second: Calibrator) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """Return by what to multiply figures of one recording, then what to add, for them to be those of another.

    And whether the other one's lidar is mirrored by its settings where the first one's is not, or the other way round.
    Wheels are factors of the counters, and counters of the diameter in the settings; a latency is what the settings
    leave. Raises `CalibrationError` for a recording without settings.
    """
    scale, shift = np.ones(len(NAMES)), np.zeros(len(NAMES))
    if first.config is None or second.config is None:
        raise CalibrationError("the recording does not begin with a robot's settings: record with fognav map record")
    wraps = [config.drive_train.travel_wrap_m for config in (first.config, second.config)]
    if all(map(math.isfinite, wraps)):
        scale[:2] = wraps[0] / wraps[1]
    lidars = first.config.localization, second.config.localization
    latencies = [lidar.lidar_latency or 0.0 for lidar in lidars]
    shift[NAMES.index("latency")] = latencies[0] - latencies[1]
    return scale, shift, bool(lidars[0].lidar_mirrored) != bool(lidars[1].lidar_mirrored)


def write(robot_file: Path, changed: list[Changed], source: str) -> None:
    """Write new values into a robot's file, the old ones beside them as comments; raises `WrongUseError`."""
    settings_file.write(robot_file, [(c.setting, c.before, c.now) for c in changed], "calibrated", source)


def hash_of(log: Path) -> str:
    """Return the beginning of a log's hash, by which its result can be traced."""
    return f"{log.name} {hashlib.sha256(log.read_bytes()).hexdigest()[:12]}"


def tell(found: Calibration, changed: list[Changed], accepted: dict[str, float], *, written: bool) -> None:
    """Print what was found, and what became of it."""
    for change in changed:
        half = "" if change.half is None else f" +- {change.half:.5f}"
        print_answer(f"{change.setting:32} {change.before!s:>10} -> {change.now}{half}")
    print_answer(f"by {found.steps} pairs of scans; rms {1000 * found.residual_m:.1f} mm, {found.residual_rad:.4f} rad")
    print_answer(f"noise of the wheels, as odometry.alphas: {', '.join(f'{share:.5f}' for share in found.noise)}")
    for name, value in accepted.items():
        print_answer(f"{name:32} {value}")
    if written:
        print_answer(f"the robot drives by it after: {RESTART}")
    else:
        print_answer("nothing was written: add --write --robot-file robot.toml")


def as_json(found: Calibration, changed: list[Changed], accepted: dict[str, float]) -> dict[str, Any]:
    """Return what the command prints as JSON."""
    by_name = {change.setting: change for change in changed}
    diameter = by_name["base.options.wheel_diameter_m"].before
    assert isinstance(diameter, float)

    def figure(name: str, factor: float = 1.0) -> dict[str, Any]:
        value, half = found.figures[name]
        return {
            "value": round(factor * value, 5),
            "interval": [round(factor * (value - half), 5), round(factor * (value + half), 5)],
        }

    return {
        "wheel_left_mm": figure("left", 1000.0 * diameter),
        "wheel_right_mm": figure("right", 1000.0 * diameter),
        "axle_m": figure("axle"),
        "lidar": {"x_m": figure("x"), "y_m": figure("y"), "yaw_rad": figure("yaw"), "mirrored": found.mirrored},
        "latency_s": figure("latency"),
        "steps": found.steps,
        "residual_m": round(found.residual_m, 4),
        "residual_rad": round(found.residual_rad, 5),
        "alphas": [round(share, 6) for share in found.noise],
        "changes": {change.setting: [change.before, change.now] for change in changed},
        **accepted,
    }
