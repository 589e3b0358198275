"""The options of a demonstration, the servers that it runs on, and the drive that they give on a site."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from fog_contracts.messages import Place, ProfileName
from fog_runtime.configuration import parts
from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.configuration.robot_file import ROBOT_FILE, default_robot, load_robot
from fog_runtime.configuration.site import LoadedSite
from fog_supervisor import servers
from fognav import programs, system
from fognav.output import WrongUseError
from fognav_sim import emulators
from fognav_sim.drive.hazard import HazardRequest


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options of `fognav demo`, and what an experiment asks for beyond them.

    `profile`: who plans. `request`: which area becomes blocked, and when; None draws both. `settings`: further FOGNAV_*
    variables of all processes, without that prefix. `on_robot_start` is called with the id of each process of the robot
    that is started, but not with those of its children.
    """

    seed: int = 1
    speed: float = 1.0
    hazard: bool = True
    base: str = DEFAULT_BASE
    lidar: str = DEFAULT_LIDAR
    robot_file: Path | None = None
    keep_running: bool = False
    record: Path | None = None
    profile: ProfileName = "fog"
    request: HazardRequest | None = None
    settings: Mapping[str, str] = field(default_factory=dict)
    on_robot_start: Callable[[int], object] | None = None
    guest: str = ""
    """By what a robot of others follows, if one does: `ros2`, `vda5050`."""
    embedded: frozenset[str] = frozenset()
    """The servers that are Python packages, because they can't be installed here."""


def hardware(robot_file: Path | None, base: str | None, lidar: str | None) -> tuple[str, str]:
    """Return the names of base and lidar: those given, else the robot file's; raises `SettingsError` for the file."""
    robot = (load_robot({ROBOT_FILE: str(robot_file)}) if robot_file else default_robot()).settings
    return base or robot.base.driver, lidar or robot.lidar.driver


@dataclass(frozen=True, kw_only=True)
class DrivePlan:
    """A drive of a site's first robot to the goal of its `[demo]`; with `hazard` its path becomes blocked."""

    site: LoadedSite
    options: Options
    robot: str
    place: str
    """Id of the place that is the goal."""
    goal: Place
    hazard: bool

    @classmethod
    def of(cls, site: LoadedSite, options: Options) -> "DrivePlan":
        """Return the plan; raises `WrongUseError` for a site without `[demo]` or robot, or for unknown hardware."""
        for option, name, group in (
            ("--base", options.base, emulators.BASES),
            ("--lidar", options.lidar, emulators.LIDARS),
        ):
            known = parts.names(group)
            if name not in known:
                raise WrongUseError(f"{option}: unknown name {name!r}; use one of: {', '.join(known)}")
        demo = site.site.demo
        if demo is None:
            raise WrongUseError(f"{site.directory}/site.toml has no [demo]: add it with a start, a goal and areas")
        if not site.site.robots:
            raise WrongUseError(f"{site.directory}/site.toml has no [[robots]]: add one with its start")
        return cls(
            site=site,
            options=options,
            robot=site.site.robots[0].id,
            place=demo.goal,
            goal=site.site.places[demo.goal],
            hazard=options.hazard and bool(demo.areas),
        )

    @property
    def watched_areas(self) -> set[str]:
        """Ids of the areas that have nodes."""
        return {node.area for node in self.site.site.nodes}


_TOOLS: Final = {programs.BROKER: system.MOSQUITTO, programs.REDIS: system.REDIS}


def embedded_servers(*, forced: bool, yes: bool, print_line: Callable[[str], None]) -> frozenset[str]:
    """Return which servers run as Python packages, after an attempt to install what is missing, and say what they lack.

    All of them when `forced`. Raises `MissingToolsError` if no package stands in for a missing one.
    """
    missing = list(_TOOLS)
    if not forced:
        try:
            system.ensure(list(_TOOLS.values()), yes=yes, print_line=print_line)
        except system.MissingToolsError as error:
            missing = [name for name, tool in _TOOLS.items() if system.find(tool) is None]
            if not all(servers.has_stand_in(name) for name in missing):
                raise
            print_line(str(error))
        else:
            return frozenset()
    print_line("this demo runs without them, on Python packages. They are for trying Fognav only:")
    for name in missing:
        package, limits = servers.STAND_INS[name]
        print_line(f"  {package} instead of {_TOOLS[name].name}: {limits}")
    return frozenset(missing)
