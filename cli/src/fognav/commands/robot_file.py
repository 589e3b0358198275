"""`fognav robot new` and `check`: a robot's commented file, and the settings that it gives."""

import os
from pathlib import Path
from typing import Annotated

import typer

from fog_contracts.costs import ROBOT_RADIUS
from fog_contracts.generate.robot_toml import robot_toml, setting_text
from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.configuration.robot_file import ROBOT_FILE, RobotFile, default_robot, describe_robot, load_robot
from fog_runtime.configuration.settings import SettingsError
from fog_runtime.files import SHARED, atomic_write
from fognav.operate.options import JsonOption
from fognav.output import (
    NOT_TRUE,
    WrongUseError,
    exit_codes,
    fail,
    print_json,
    print_line,
    print_result,
    writing,
)
from robot_agent import registry
from robot_agent.agent.settings import read_footprint, refuse_body, refuse_contradictions, remarks
from robot_agent.footprint import Footprint
from robot_agent.serial_port import PortNameError, check_port_name

robot_app = typer.Typer(help="Send, stop and watch robots; describe a new one.", no_args_is_help=True)


def robot_new(
    *,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="File to write, e.g. robot.toml.")],
    base: Annotated[str, typer.Option("--base", metavar="NAME", help="The robot's base.")] = DEFAULT_BASE,
    lidar: Annotated[str, typer.Option("--lidar", metavar="NAME", help="The robot's lidar.")] = DEFAULT_LIDAR,
    json: JsonOption = False,
) -> None:
    """Write a commented settings file for a robot, with every default.

    Set the ports of base and lidar in it, then what you have measured; docs/robot-setup.md leads through it.
    """
    with exit_codes():
        if out.exists():
            raise WrongUseError(f"{out} already exists: name another file with --out, or remove it")
        text = robot_text(default_robot(base, lidar))
        with writing(out, "Name another file with --out"):
            atomic_write(out, text.encode(), mode=SHARED)
        line = f"wrote {out}: set the ports in it, then check it with: fognav robot check {out}"
        print_result({"file": str(out), "base": base, "lidar": lidar}, line, json=json, write=print_line)


def robot_check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The robot's settings file.")],
    *,
    json: JsonOption = False,
) -> None:
    """Check a robot's settings file, and print what it sets.

    FOGNAV_ variables that override single settings count, as they do for the robot's processes. The exit code is 1
    while something is wrong, or a port is missing.
    """
    try:
        robot = load_robot({**os.environ, ROBOT_FILE: str(file)})
        values = effective(robot)
        missing = check_ports(robot)
        remarks = [f"{name} is not set: a robot needs it, a demo does not" for name in missing]
        remarks += contradictions(robot)
    except SettingsError as error:
        if json:
            print_json({"ok": False, "setting": error.setting, "problem": str(error)})
            raise typer.Exit(NOT_TRUE) from error
        fail(str(error))
    lines = [f"{name} = {setting_text(value)}" for name, value in values.items()]
    print_result({"ok": not missing, "remarks": remarks, **values}, *lines, *remarks, json=json)
    if missing:
        raise typer.Exit(NOT_TRUE)


def check_ports(robot: RobotFile) -> list[str]:
    """Return the settings of ports that are empty; raises `SettingsError` for a port that no process would open."""
    ports = {"base.port": robot.settings.base.port, "lidar.port": robot.settings.lidar.port}
    for name, port in ports.items():
        try:
            check_port_name(port)
        except PortNameError as error:
            raise robot.error(name, str(error), "On the robot: ls -l /dev/serial/by-id /dev/serial/by-path") from error
    if ports["base.port"] and ports["base.port"] == ports["lidar.port"]:
        raise robot.error("lidar.port", "this is the port of the base, too", "Give each device its own")
    return [name for name, port in ports.items() if not port]


def contradictions(robot: RobotFile) -> list[str]:
    """Return what a person may not expect of the settings; raises `SettingsError` for those that contradict others."""
    base, footprint = registry.make_base(robot), read_footprint(robot)
    refuse_contradictions(robot, base)
    told = remarks(robot, registry.make_lidar(robot).traits, footprint or Footprint.circle(ROBOT_RADIUS))
    if footprint is not None:
        refuse_body(robot, base, footprint)
        return told
    if robot.settings.base.driver != DEFAULT_BASE:
        told.append(
            "body.footprint is not set: the body is a circle of the `radius` of the robot's entry in the site's file"
        )
    try:
        refuse_body(robot, base, Footprint.circle(ROBOT_RADIUS))
    except SettingsError as error:
        # The site's folder need not be at hand: on the robot this is judged by its `radius`.
        told.append(f"unless the site gives this robot a larger `radius` than {ROBOT_RADIUS} m: {error}")
    return told


def robot_text(robot: RobotFile) -> str:
    """Return a commented robot file with these settings; raises `SettingsError` for unknown hardware."""
    return robot_toml(robot.settings, *registry.options(robot))


def effective(robot: RobotFile) -> dict[str, object]:
    """Return all effective settings by their dotted names; raises `SettingsError` for what no process would accept."""
    registry.make_base(robot)
    registry.make_lidar(robot)
    read_footprint(robot)
    return describe_robot(robot, *registry.options(robot))
