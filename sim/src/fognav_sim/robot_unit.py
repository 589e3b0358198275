"""A simulated robot for a fog node that runs elsewhere: `python -m fognav_sim.robot_unit`, as in docker-compose.yml.

Runs simulator, watchdog, guardian and agent in one container, because containers can't share ptys, and acts as the
operator: it enables the robot whenever it waits for that, and sends it back and forth between the demo's two places.
"""

from __future__ import annotations

import asyncio
import http.client
import os
import sys
from pathlib import Path
from typing import Final

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.messages import RobotState
from fog_runtime import logs, process
from fog_runtime.clock import SystemClock, ticker
from fog_runtime.configuration.settings import CommonSettings, SettingsError, describe, load
from fog_runtime.configuration.site import load_site
from fog_runtime.credentials import Credentials
from fog_runtime.health import Health, serve_health
from fog_runtime.keys import read_operator_key
from fog_runtime.robot_commands import RobotCommands
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor.net import put_goal
from fog_supervisor.supervisor import Event, Program, Supervisor
from fognav_sim.drive.operator import OperatorCommand, OperatorPolicy, Shuttle

SILENT_S: Final = 5.0
"""A robot tells its state once a second."""


class UnitHealth:
    """The conditions of a robot's health; times are in s of one monotonic clock."""

    def __init__(self, robot: str) -> None:
        """Start without a state: a robot that has never spoken is not well."""
        self._robot = robot
        self._state: RobotState | None = None
        self._at = 0.0

    def on_state(self, state: RobotState, now: float) -> None:
        """Take note of the robot's state."""
        self._state, self._at = state, now

    def conditions(self, now: float) -> dict[str, str]:
        """Return why each condition is not met, empty if it is: `speaks`, `no_fault`."""
        if self._state is None:
            return {"speaks": f"{self._robot} has told no state yet", "no_fault": "its state is unknown"}
        silent = now - self._at
        speaks = "" if silent <= SILENT_S else f"{self._robot} has told no state for {silent:.0f} s"
        fault = f"FAULT: {'; '.join(self._state.reasons)}" if self._state.mode == "FAULT" else ""
        return {"speaks": speaks, "no_fault": fault}


_POLICY_PERIOD_S: Final = 1.0
_TIMEOUT_S: Final = 5.0
_log = logs.get("sim-robot")


class Settings(CommonSettings, frozen=True, kw_only=True):
    """Settings of the simulated robot, besides those common to all processes."""

    run_dir: Path
    planner_url: str
    token_file: Path
    credentials_dir: Path | None = None
    """Folder with the credentials of `console`, `sim`, the robot and its nodes, `NAME.toml`; None: all are nobody."""
    robot: str = ""
    seed: int = 1
    agent_http_port: int = 9100
    health_port: int = 9101
    """Where `/readyz` says whether the robot speaks over the fog and is in no fault."""

    def file_of(self, user: str) -> Path | None:
        """Return the file of a user's credentials."""
        return None if self.credentials_dir is None else self.credentials_dir / f"{user}.toml"


class _Operator:
    """Acts as the operator of the robot: enables it, resets faults, sends goals."""

    def __init__(
        self, settings: Settings, robot: str, places: tuple[str, str], edge: ZenohEdge, health: Health
    ) -> None:
        self._settings = settings
        self._robot = robot
        self._clock = SystemClock(settings.speed)
        assert settings.operator_key_file is not None
        key = read_operator_key(settings.operator_key_file)
        self._commands = RobotCommands(edge, operator="sim-robot", key=key)
        self._token = settings.token_file.read_text("ascii").strip()
        self._state: RobotState | None = None
        self._policy = OperatorPolicy(self._clock.now())
        self._shuttle = Shuttle(*places)
        self._health = health
        self._unit_health = UnitHealth(robot)
        edge.subscribe(ch.ROBOT_STATE, RobotState, self._on_state, robot=robot)

    async def run(self) -> None:
        """Send the commands and goals that are due, once a second, until cancelled."""
        async for now in ticker(self._clock, _POLICY_PERIOD_S):
            for name, problem in self._unit_health.conditions(now).items():
                self._health.set(name, not problem, problem)
            state = self._state
            if state is None:
                continue
            self._policy.on_state(state, now)
            if (command := self._policy.command_due(now)) is not None:
                await self._send_command(command, state)
            if (place := self._shuttle.goal_due(state)) is not None:
                await self._send_goal(place)

    def _on_state(self, _ids: dict[str, str], state: RobotState) -> None:
        """Record a state; an arrival is reported for a tenth of a second only, so every state is looked at."""
        self._state = state
        self._unit_health.on_state(state, self._clock.now())
        if (place := self._shuttle.on_state(state)) is not None:
            _log.info("arrived", place=place, legs=self._shuttle.legs)

    async def _send_command(self, kind: OperatorCommand, state: RobotState) -> None:
        try:
            reply = await self._commands.send(kind, self._robot, state, timeout_s=_TIMEOUT_S)
        except ContractError as error:
            _log.warning("command_failed", kind=kind, reason=str(error))
            return
        _log.info(
            "command_sent",
            kind=kind,
            accepted=reply is not None and reply.accepted,
            reason=reply.reason if reply else "no reply",
        )

    async def _send_goal(self, place: str) -> None:
        url = self._settings.planner_url
        try:
            answer = await asyncio.to_thread(put_goal, url, self._robot, place, self._token)
            problem = None if answer.status < http.client.BAD_REQUEST else answer.reason
        except OSError as error:
            problem = str(error)
        if problem is not None:
            _log.warning("goal_failed", place=place, reason=problem, url=url)
            return
        self._shuttle.under_way = True
        _log.info("goal_accepted", place=place)


def _programs(settings: Settings, robot: str) -> list[Program]:
    run = settings.run_dir
    logs_folder = run / "logs"
    own = {
        "RUN_DIR": run / "wires",
        "BASE_PORT": run / "wires" / "base",
        "LIDAR_PORT": run / "wires" / "lidar",
        "GUARDIAN_SOCKET": run / "guardian.sock",
        "ROBOT": robot,
    }
    if settings.credentials_dir is not None:
        own["NODE_CREDENTIALS_DIR"] = settings.credentials_dir
    programs = []
    for name, module, http_port, user in (
        ("simulator", "fognav_sim", 0, "sim"),
        ("watchdog", "robot_agent.guardian.watchdog", 0, None),
        ("robot-agent", "robot_agent", settings.agent_http_port, robot),
    ):
        data = settings.data_dir / name
        for folder in (data, logs_folder, run / "wires"):
            folder.mkdir(parents=True, exist_ok=True)
        mine = {**own, "DATA_DIR": data, "HTTP_PORT": http_port}
        if user is not None and (file := settings.file_of(user)) is not None:
            mine["CREDENTIALS_FILE"] = file
        environment = {**os.environ, **{f"FOGNAV_{key}": str(value) for key, value in mine.items()}}
        arguments = (sys.executable, "-m", module)
        programs.append(Program(name=name, arguments=arguments, log=logs_folder / name, environment=environment))
    return programs


def _log_program_event(event: Event) -> None:
    _log.info(f"program_{event.kind}", program=event.program, detail=event.detail)


async def main() -> None:
    """Start the robot's programs and operate the robot until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("sim-robot", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    site = load_site(settings.site_dir).site
    if site.demo is None or not site.robots:
        raise SettingsError(
            f"{settings.site_dir}/site.toml needs [demo] and a robot in [[robots]] for a simulated drive"
        )
    if settings.operator_key_file is None:
        raise SettingsError("FOGNAV_OPERATOR_KEY_FILE is missing: name the site's operator.key")
    robot = settings.robot or site.robots[0].id
    health = Health("speaks", "no_fault")
    async with (
        ZenohEdge.open(
            connect=settings.zenoh_endpoints,
            clock=SystemClock(settings.speed),
            role="console",
            id=robot,
            site=settings.site or site.id,
            credentials=Credentials.read(settings.file_of("console")),
        ) as edge,
        Supervisor(_log_program_event) as supervisor,
    ):
        for program in _programs(settings, robot):
            supervisor.add(program)
            supervisor.start(program.name)
        with serve_health(health, "127.0.0.1", settings.health_port):
            await _Operator(settings, robot, (site.demo.start, site.demo.goal), edge, health).run()


if __name__ == "__main__":
    process.run(main)
