"""One drive of an experiment by real processes: the demonstration's system, sent on a drawn route."""

import asyncio
import contextlib
import json
import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from fog_contracts.site import DemoPlan, Site
from fog_runtime import logs
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.maps import save_map
from fog_runtime.configuration.site import SITE_FILE, LoadedSite, load_site
from fog_supervisor.supervisor import NotReadyError
from fognav import __version__
from fognav.demo.options import Options, hardware
from fognav.demo.run import Demo
from fognav.output import FailedError
from fognav_experiments.bench.robot import NORMAL_PRIORITY, cpu_quota
from fognav_experiments.comparison.drives import (
    PROFILE_OF_SETUP,
    ROBOTS_PROCESSES,
    MeasuredDrive,
    RouteDraw,
    Setup,
    drive_name,
    ends_of,
    facts,
    start_of,
)
from fognav_experiments.comparison.records import DriveFiles
from fognav_experiments.comparison.robot_metrics import RobotUsage, watch
from fognav_experiments.comparison.runner import Task
from fognav_sim.drive.hazard import HazardRequest

if TYPE_CHECKING:
    from fognav.demo.attempt import Attempt

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """How drives run: `speed` times as fast as real time, the robot's processes within a share of one core, or not.

    `commit`: the program's revision, which is only recorded. `robot_file`: the robot's settings, by default the
    thesis's.
    """

    speed: float = 1.0
    cpu_quota: float | None = None
    commit: str = ""
    robot_file: Path | None = None

    def name(self, task: Task) -> str:
        """Return the name of a drive's record."""
        return drive_name(task.drawn.run, task.drawn.route.name, task.setup, self.cpu_quota, self.speed)


def live_drives(
    site: LoadedSite,
    asked: Sequence[Task],
    files: DriveFiles[MeasuredDrive],
    options: LiveOptions,
    on_event: Callable[[str], None],
) -> Iterator[MeasuredDrive]:
    """Drive those that have not succeeded yet, one after another, and yield each record once it is written.

    What failed stays beside what is driven again. Raises as `drive_live` does.
    """
    for task in asked:
        made = files.attempts(options.name(task))
        if not any(drive.success for drive in made):
            drive = drive_live(site, task.drawn, task.setup, options, on_event)
            drive = msgspec.structs.replace(drive, attempt=len(made) + 1)
            files.write(drive)
            yield drive


def drive_live(
    site: LoadedSite, drawn: RouteDraw, setup: Setup, options: LiveOptions, on_event: Callable[[str], None]
) -> MeasuredDrive:
    """Drive a drawn route in a setup by real processes; blocks until all of them have ended.

    Raises `FailedError` for a system that does not start and for an interruption, `WrongUseError` for a quota that this
    machine can't enforce.
    """
    with contextlib.ExitStack() as contexts:
        folder = Path(contexts.enter_context(tempfile.TemporaryDirectory(prefix="fognav-drive-")))
        write_route(site, drawn, folder)
        settings: Mapping[str, str] = {}
        on_robot: Callable[[int], object] = _nothing
        if options.cpu_quota is not None:
            on_robot, settings = contexts.enter_context(cpu_quota(options.cpu_quota)).add, NORMAL_PRIORITY
        base, lidar = hardware(options.robot_file, None, None)
        asked = Options(
            base=base,
            lidar=lidar,
            robot_file=options.robot_file,
            seed=drawn.seed,
            speed=options.speed,
            profile=PROFILE_OF_SETUP[setup],
            request=HazardRequest(area=drawn.area, trigger_m=drawn.trigger_m),
            settings=settings,
            on_robot_start=on_robot,
        )
        demo = Demo(load_site(folder), asked, on_event)
        usage = DemoUsage(demo, on_event)
        try:
            report = asyncio.run(_run(demo, usage))
        except (NotReadyError, TimeoutError) as error:
            raise FailedError(f"drive {drawn.run}, {drawn.route.name}, {setup}: {error}") from error
        return msgspec.structs.replace(_record(demo, report, drawn, setup, options), **usage.fields(report))


def write_route(site: LoadedSite, drawn: RouteDraw, folder: Path) -> None:
    """Write a site like this one, whose robot starts where the route does, and whose demonstration is the route."""
    start, goal = ends_of(site, drawn)
    changed = msgspec.structs.replace(
        site.site,
        map="map.yaml",
        places=site.site.places | {drawn.route.start: start, drawn.route.goal: goal},
        robots=[msgspec.structs.replace(site.site.robots[0], start=start_of(site, drawn))],
        demo=DemoPlan(start=drawn.route.start, goal=drawn.route.goal, areas=[drawn.area]),
    )
    save_map(folder / "map", site.map)
    (folder / SITE_FILE).write_text(site_text(changed), "utf-8")


def site_text(site: Site) -> str:
    """Return a site as TOML, which `load_site` reads again."""
    values = msgspec.to_builtins(site)
    return "".join(f"{name} = {_toml(value)}\n" for name, value in values.items() if value is not None)


def _toml(value: Any) -> str:  # noqa: ANN401  # whatever a site holds
    match value:
        case dict():
            entries = [f"{json.dumps(key)} = {_toml(item)}" for key, item in value.items() if item is not None]
            return f"{{ {', '.join(entries)} }}"
        case list() | tuple():
            return f"[{', '.join(_toml(item) for item in value)}]"
        case bool() | str():
            return json.dumps(value, ensure_ascii=False)
        case int() | float():
            return repr(value)
        case _:
            raise TypeError(f"a site holds a {type(value).__name__}, which TOML does not have")


class DemoUsage:
    """What the robot's exporter tells while a demonstration drives; of its last attempt only."""

    def __init__(self, demo: Demo, tell: Callable[[str], None]) -> None:
        self._demo = demo
        self._tell = tell
        self._attempt: Attempt | None = None
        self._usage = RobotUsage()

    async def watch(self) -> None:
        """Read it until this is cancelled."""
        await watch(self._usage, self._address, self._now, self._tell)

    def _now(self) -> float:
        return SystemClock(self._demo.scene.speed).now()

    def _address(self) -> str | None:
        """Return where the robot's metrics are while it drives; None before and after."""
        attempt = self._demo.attempt
        if attempt is not self._attempt:
            self._attempt = attempt
            self._usage.clear()
        state, drives = attempt.scene.state, attempt.drive is not None and attempt.scene.outcome is None
        return state.metrics if state is not None and drives else None

    def fields(self, report: Mapping[str, Any]) -> dict[str, Any]:
        """Return what a record holds of the robot's processes by it, and of all others by the system's account."""
        found, speed = self._usage.fields(), self._demo.scene.speed
        if not found:
            return {}
        others = {name: used for name, used in report["processes"].items() if name not in ROBOTS_PROCESSES}
        cpu = {name: round(used["cpu_percent"] / speed, 2) for name, used in others.items()}
        memory = {name: used["rss_mb"] for name, used in others.items()}
        return found | {"cpu_percent": cpu | found["cpu_percent"], "peak_mb": memory | found["peak_mb"]}


async def _run(demo: Demo, usage: DemoUsage) -> dict[str, object]:
    logs.configure("experiment", "warning", "text")
    stop = asyncio.Event()
    with _signals(stop):
        watching = asyncio.create_task(usage.watch())
        try:
            report = await demo.run(stop)
        finally:
            watching.cancel()
    if stop.is_set():
        raise FailedError("interrupted: repeat the command to go on with this drive")
    return report


@contextlib.contextmanager
def _signals(stop: asyncio.Event) -> Iterator[None]:
    loop = asyncio.get_running_loop()
    for number in _SIGNALS:
        loop.add_signal_handler(number, stop.set)
    try:
        yield
    finally:
        for number in _SIGNALS:
            loop.remove_signal_handler(number)


def _record(
    demo: Demo, report: Mapping[str, Any], drawn: RouteDraw, setup: Setup, options: LiveOptions
) -> MeasuredDrive:
    summary, processes, speed = demo.attempt.summary(), report["processes"], demo.scene.speed
    return MeasuredDrive(
        **facts(MeasuredDrive, drawn, setup, summary),
        kind="live",
        cpu_percent={name: round(used["cpu_percent"] / speed, 2) for name, used in processes.items()},
        peak_mb={name: used["rss_mb"] for name, used in processes.items()},
        cpu_quota=options.cpu_quota,
        speed=speed,
        asked_speed=options.speed,
        restarts=sum(demo.attempt.restarts.values()),
        load=round(os.getloadavg()[0], 2),
        version=__version__,
        commit=options.commit,
    )


def _nothing(_pid: int) -> None:
    """Do nothing with a process that was started."""
