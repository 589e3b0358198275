"""`fognav robot bringup`: all that is seen of a robot, judged; for its page, a terminal, and once for programs."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec import Struct
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fog_runtime.configuration.robot_file import ROBOT_FILE, RobotFile, load_robot
from fog_runtime.configuration.settings import SettingsError
from fognav import __version__
from fognav.output import WrongUseError, answers
from fognav.robot_page import computer, findings, settings_file
from fognav.robot_page.findings import Finding
from fognav.robot_page.mounting import OwnReturns, changes, masked_sectors, missing_by_sector
from fognav.robot_page.recording_view import until_told
from fognav.robot_page.view import RobotView
from robot_agent import registry
from robot_agent.agent.hand_driving import HandReply
from robot_agent.agent.local_link import Equipment
from robot_agent.agent.recording.input_log import BaseReceived, Published, ScanReceived
from robot_agent.local_client import LocalRobot, LocalRobotError
from robot_agent.localization.odometry import wheel_travel

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.robot import LidarSettings
    from fognav.robot_page.mounting import Sector
    from robot_agent.hardware import BaseStatus

INSTALLED_FILE: Final = Path("/etc/fognav/robot.toml")
_INSTALLED_DATA: Final = Path("/var/lib/fognav")
_SWITCHES: Final = ("bumper_left", "bumper_right", "cliff", "wheel_drop")
_SEEN_S: Final = 5.0
_RATE_SCANS: Final = 6
_JUDGED_S: Final = 0.5
_LOOKED_S: Final = 5.0
_STANDS_M_S: Final = 0.005
_DRIVES_M_S: Final = 0.03
_RETRY_S: Final = 0.5
_DRAWN_S: Final = 0.5
_SHOWN_M: Final = 3.0
_STYLES: Final = {"ok": "green", "warn": "yellow", "bad": "red", "unknown": "cyan"}


Mounting = tuple[float, bool, tuple[tuple[float, ...], ...]]
"""Yaw (rad), whether mirrored, and masks in the robot's frame, rounded as in the file."""


class Mount(Struct, frozen=True, tag="mount", kw_only=True):
    """Write how the lidar is mounted into robot.toml; masks in the robot's frame; answered."""

    yaw_rad: float
    mirrored: bool
    masks: list[tuple[float, float]]


class Place:
    """The robot's settings file, and this computer, looked at every few seconds on a thread of its own."""

    def __init__(self, robot_file: Path | None, environ: Mapping[str, str] = os.environ) -> None:
        """Find the file: named, by its variable, or where it is installed."""
        named = robot_file or (Path(environ[ROBOT_FILE]) if environ.get(ROBOT_FILE) else None)
        self.file = named or (INSTALLED_FILE if INSTALLED_FILE.exists() else None)
        self.processes: dict[str, int] = {}
        self._environ = {**environ, **({ROBOT_FILE: str(self.file)} if self.file else {})}
        data = environ.get("FOGNAV_DATA_DIR")
        self._data = Path(data) if data else _INSTALLED_DATA if _INSTALLED_DATA.is_dir() else Path.cwd()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="look")
        self._looked_at = -math.inf
        self._future = self._thread.submit(list[Finding])
        self._found: list[Finding] = []
        self._written: Mounting | None = None

    def robot(self) -> RobotFile:
        """Return the settings as they are now; raises `SettingsError`."""
        return load_robot(self._environ)

    def look(self, *, wait: bool = False) -> list[Finding]:
        """Return what was found at the last look at the computer, and look again if that was a while ago."""
        if self._future.done():
            self._found = self._future.result()
            if time.monotonic() - self._looked_at > _LOOKED_S:
                self._looked_at = time.monotonic()
                self._future = self._thread.submit(computer.look, dict(self.processes), self._data)
        if wait:
            self._found = self._future.result()
        return self._found

    def write(self, mount: Mount, running: Mounting | None = None) -> HandReply:
        """Write what a person has set by looking; the reply says what was done, or why it was not.

        running: how the agent takes the lidar to be mounted, from which the person began.
        """
        if self.file is None:
            reason = "no settings file is known: start this with --robot-file robot.toml (fognav robot new makes one)"
            return HandReply(accepted=False, reason=reason)
        try:
            lidar = self.robot().settings.lidar
            if running and _mounting(lidar.yaw_rad, lidar.masks, mirrored=lidar.mirrored) not in {
                running,
                self._written,
            }:
                # What was begun before a calibration would undo it.
                reason = f"{self.file} was changed since the agent has read it: restart the agent, then look again"
                return HandReply(accepted=False, reason=reason)
            changed = changes(lidar, mount.yaw_rad, mount.masks, mirrored=mount.mirrored)
            if not changed:
                return HandReply(accepted=True, reason=f"{self.file} has this already")
            settings_file.write(self.file, changed, "set", "by looking: fognav robot bringup")
            lidar = self.robot().settings.lidar
            self._written = _mounting(lidar.yaw_rad, lidar.masks, mirrored=lidar.mirrored)
        except (WrongUseError, SettingsError) as error:
            return HandReply(accepted=False, reason=str(error)[:400])
        names = ", ".join(setting for setting, _, _ in changed)
        return HandReply(accepted=True, reason=f"{self.file}: wrote {names}. Restart the agent, then look again")


class BringupView(RobotView):
    """The robot as far as it has told, and what follows of it for its parts."""

    def __init__(self, place: Place) -> None:
        super().__init__()
        self.place = place
        self.problem = ""
        """Why the agent can't be reached."""
        self.equipment: Equipment | None = None
        self._now = 0.0
        self._heard_from = math.inf
        self._scanned_at = -math.inf
        self._damaged_before = 0
        self._scans: deque[ScanReceived] = deque(maxlen=40)
        self._own: OwnReturns | None = None
        self._seen: dict[str, frozenset[bool]] = {name: frozenset() for name in _SWITCHES}
        self._rolled = (0.0, 0.0)
        self._rest_v: float | None = None
        self._load_v: float | None = None
        self._judged: list[Finding] = []
        self._judged_at = -math.inf
        self._proposed: list[Sector] = []

    def take(self, entry: Any) -> bool:  # noqa: ANN401  # as its parent
        """Take an entry in; return whether there is something new to show."""
        before = self.base
        new = super().take(entry)
        match entry:
            case Equipment():
                if self.equipment is None:
                    self._damaged_before = entry.damaged.get("lidar", 0)
                self.equipment, self.place.processes = entry, entry.processes
            case BaseReceived():
                self._hear(entry.now)
                self._on_base(entry, before)
            case ScanReceived():
                self._hear(entry.now)
                self._scanned_at = entry.now
                self._on_scan(entry)
            case Published():
                self._hear(float(entry.message.get("clock", 0.0)))
        return new

    def _hear(self, now: float) -> None:
        self._now = max(self._now, now)
        self._heard_from = min(self._heard_from, now or math.inf)

    def _on_base(self, entry: BaseReceived, before: BaseReceived | None) -> None:
        status = entry.feedback.status
        for name in _SWITCHES:
            self._seen[name] |= {bool(getattr(status, name))}
        if before is None or self.config is None:
            return
        wrap = self.config.drive_train.travel_wrap_m
        new, old = entry.feedback.odometry, before.feedback.odometry
        rolled = wheel_travel(new.left_m, old.left_m, wrap), wheel_travel(new.right_m, old.right_m, wrap)
        self._rolled = self._rolled[0] + rolled[0], self._rolled[1] + rolled[1]
        self._on_power(status, max(map(abs, rolled)) / max(entry.now - before.now, 1e-3))

    def _on_power(self, status: BaseStatus, wheel_m_s: float) -> None:
        voltage = None if status.power is None else status.power.voltage_v
        if voltage is None or status.charging:
            return
        if wheel_m_s < _STANDS_M_S:
            self._rest_v = voltage if self._rest_v is None else max(self._rest_v, voltage)
        # Only what the motors turn loads the battery, not a person who rolls the robot.
        elif wheel_m_s > _DRIVES_M_S and self.state.get("mode") == "TELEOP":
            self._load_v = voltage if self._load_v is None else min(self._load_v, voltage)

    def _on_scan(self, entry: ScanReceived) -> None:
        self._scans.append(entry)
        if self.config is None:
            return
        lidar = self.config.localization
        if self._own is None:
            self._own = OwnReturns(self.config.footprint.vertices, (lidar.lidar_x, lidar.lidar_y, lidar.lidar_yaw))
        left, right = self._rolled
        self._own.take(entry.scan().unmasked(), (right - left) / self.config.drive_train.axle_m)

    # --- what follows of it -----------------------------------------------------------------------------------------

    def findings(self, *, wait: bool = False) -> list[Finding]:
        """Return all judgements, of the parts and of the computer."""
        return [*self._judge(), *self.place.look(wait=wait)]

    def _judge(self) -> list[Finding]:
        try:
            robot: RobotFile | None = self.place.robot()
            assert robot is not None
            found = [findings.settings(self.place.file, in_use=self._in_use(robot.settings.lidar))]
            found += _ports(robot)
            rated = 1.0 / registry.make_lidar(robot).traits.scan_period_s
            base, lidar, low = (
                robot.settings.base.driver,
                robot.settings.lidar.driver,
                robot.settings.power.low_fraction,
            )
            counts = findings.counts_per_m(msgspec.structs.asdict(registry.options(robot)[0]))
        except SettingsError as error:
            found, rated, base, lidar, low, counts = [_wrong(error)], None, "base", "lidar", 0.2, None
        found.append(findings.agent(self.problem))
        if self.problem:
            return found
        told = self.equipment
        found.append(findings.versions(__version__, told.version if told else None))
        found += self._judge_lidar(lidar, rated, told or Equipment(version=""))
        found += self._judge_base(base, low, counts, told.base if told else "")
        return found

    def _in_use(self, lidar: LidarSettings) -> bool:
        """Return whether the agent has the lidar where the file says that it is; True while it has not told."""
        if self.config is None or self.equipment is None:
            return True
        has, told = self.config.localization, self.equipment
        agents = (has.lidar_x, has.lidar_y, has.lidar_yaw, told.mirrored, told.masks)
        return agents == (lidar.x_m, lidar.y_m, lidar.yaw_rad, lidar.mirrored, lidar.masks)

    def _judge_lidar(self, driver: str, rated: float | None, told: Equipment) -> list[Finding]:
        silent = max(0.0, self._now - max(self._scanned_at, self._heard_from))
        damaged = told.damaged.get("lidar", 0) - self._damaged_before
        found = [findings.lidar(driver, told.lidar, silent if self._scans or silent > 1.0 else None, damaged)]
        recent = [entry for entry in self._scans if entry.now > self._now - _SEEN_S]
        span = recent[-1].ended_at - recent[0].ended_at if recent else 0.0
        rate = (len(recent) - 1) / span if len(recent) >= _RATE_SCANS and span > 0.0 else None
        scans = [entry.scan().unmasked() for entry in recent]
        samples = float(np.mean([len(scan.ranges_m) for scan in scans])) if scans else 0.0
        found.append(findings.lidar_rate(rate, rated, samples))
        if self.config is not None:
            lidar = self.config.localization
            missing = missing_by_sector(scans, lidar.lidar_yaw, lidar.range_max)
            found.append(findings.lidar_returns(missing, masked_sectors(told.masks)))
        if self._own is not None:
            found.append(findings.own_returns(len(self._own.sectors()), turned=self._own.turned))
        return found

    def _judge_base(self, driver: str, low: float, counts: float | None, problem: str) -> list[Finding]:
        feedback = self.base.feedback if self.base else None
        found = [findings.base(driver, problem, feedback)]
        if feedback is None or problem:
            return found
        status = feedback.status
        found += [findings.switch(n, self._seen[n], now=bool(getattr(status, n))) for n in _SWITCHES]
        found.append(findings.encoders(*self._rolled, counts))
        found.append(findings.battery(status.battery, low))
        found.append(findings.voltage(status.power, self._rest_v, self._load_v))
        return found

    def write(self, mount: Mount) -> HandReply:
        """Write what a person has set by looking at the scan of this view."""
        lidar = self.config.localization if self.config else None
        if lidar is None or self.equipment is None:
            return self.place.write(mount, None)
        running = _mounting(lidar.lidar_yaw, self.equipment.masks, mirrored=self.equipment.mirrored)
        return self.place.write(mount, running)

    def as_json(self) -> dict[str, Any]:
        """Return what the page draws, and the findings."""
        if (now := time.monotonic()) - self._judged_at > _JUDGED_S:
            self._judged, self._judged_at = self.findings(), now
            self._proposed = self._own.sectors() if self._own else []
        lidar = self.config.localization if self.config else None
        mounted = {
            "x": lidar.lidar_x, "y": lidar.lidar_y, "yaw": lidar.lidar_yaw,
            "mirrored": self.equipment.mirrored, "masks": self.equipment.masks,
        } if lidar and self.equipment else None  # fmt: skip
        more = {
            "findings": [finding._asdict() for finding in self._judged],
            "mounted": mounted,
            "proposed": self._proposed,
            "file": str(self.place.file) if self.place.file else None,
        }
        return {**super().as_json(), "bringup": more}


def _mounting(yaw: float, masks: Sequence[Sequence[float]], *, mirrored: bool) -> Mounting:
    return round(yaw, 4), mirrored, tuple(tuple(round(end, 4) for end in mask) for mask in masks)


def _wrong(error: SettingsError) -> Finding:
    return Finding("settings", "bad", str(error), "fognav robot check FILE names it, too")


def _ports(robot: RobotFile) -> list[Finding]:
    known = [str(path) for folder in ("by-id", "by-path") for path in sorted(Path("/dev/serial", folder).glob("*"))]
    parts: tuple[tuple[str, Any], ...] = (("base", robot.settings.base), ("lidar", robot.settings.lidar))
    return [
        findings.port(name, part.driver, part.port, exists=Path(part.port).exists(), known=known)
        for name, part in parts
    ]


def watch(path: Path, view: BringupView, seconds: float) -> list[Finding]:
    """Watch the robot at this socket for so long (s), and return all judgements; none of it moves anything."""
    with until_told(seconds) as ends:
        _follow(path, view, ends, lambda: None)
    return view.findings(wait=True)


def show(path: Path, view: BringupView) -> list[Finding]:
    """Show findings and scan in this terminal until Ctrl-C; return the last ones."""
    with until_told(None) as ends, Live(console=answers, auto_refresh=False, screen=True) as live:
        while not ends():
            drawn = 0.0

            def draw() -> None:
                nonlocal drawn
                if time.monotonic() - drawn >= _DRAWN_S:
                    drawn = time.monotonic()
                    live.update(render(view, answers.width, answers.height), refresh=True)

            _follow(path, view, ends, draw)
            draw()
            time.sleep(_RETRY_S)
    return view.findings()


def _follow(path: Path, view: BringupView, ends: Any, on_news: Any) -> None:  # noqa: ANN401  # both are plain calls
    """Take what the robot tells into the view until `ends`, or the link breaks."""
    try:
        with LocalRobot(path) as robot:
            view.problem = ""
            while not ends():
                for entry in robot.entries(0.2):
                    if view.take(entry):
                        break
                on_news()
    except LocalRobotError as error:
        view.problem = str(error)


def table(found: Sequence[Finding]) -> Table:
    """Return the findings as people read them."""
    shown = Table(box=None, padding=(0, 1), show_header=False)
    for finding in found:
        shown.add_row(Text(finding.state, style=_STYLES[finding.state]), finding.name, Text(finding.text))
        if finding.remedy:
            shown.add_row("", "", Text(f"-> {finding.remedy}", style="dim"))
    return shown


def render(view: BringupView, width: int, height: int) -> Group:
    """Return what a terminal of this size shows: the scan, and below it what is not well first."""
    order = ("bad", "warn", "unknown", "ok")
    found = sorted(view.findings(), key=lambda finding: order.index(finding.state))
    shown = table(found)
    left = height - len(answers.render_lines(shown, answers.options.update(width=width), pad=False)) - 2
    left = max(left, height // 3)  # in a small terminal what is well is cut off
    state = f"{view.state.get('mode', 'not connected')}; drive by `fognav teleop`; Ctrl-C ends"
    return Group(Text(state, style="bold"), scan_text(view, width, left), shown)


def scan_text(view: RobotView, width: int, height: int) -> Text:
    """Draw the scan in so many characters, of 2 by 4 dots each; ahead is up, the robot is in the middle."""
    if height < 6 or width < 12:  # too small to see anything
        return Text()
    dots = min(2 * width, 4 * height)
    grid = np.zeros((dots, dots), np.bool_)
    points = view.points()
    corners = np.array(view.config.footprint.vertices if view.config else np.zeros((0, 2))).reshape(-1, 2)
    for x, y in (*points, *corners):
        row, column = int(dots / 2 * (1.0 - x / _SHOWN_M)), int(dots / 2 * (1.0 - y / _SHOWN_M))
        if 0 <= row < dots and 0 <= column < dots:
            grid[row, column] = True
    grid = grid[: dots // 4 * 4, : dots // 2 * 2]
    bits = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])  # Unicode's order of Braille dots
    cells = (grid.reshape(dots // 4, 4, dots // 2, 2) * bits[None, :, None, :]).sum(axis=(1, 3))
    return Text("\n".join("".join(chr(0x2800 + int(cell)) for cell in row) for row in cells))
