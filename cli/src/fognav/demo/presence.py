"""Makes a running demo known: to other commands by its entry in the register, to people by how to operate it."""

import os
import shlex
from pathlib import Path
from typing import Final

from fog_supervisor import net
from fognav import checkout
from fognav.demo.options import DrivePlan
from fognav.demo.scene import Scene
from fognav.operate.systems import Registration, System, registered
from fognav.output import FailedError, WrongUseError
from fognav.programs import AGENT, BROKER, ROUTER, SERVICES
from fognav.stack import Stack

PAGE: Final = "page"
_SLOW_ZONE: Final = (1.0, 0.1)
"""Radius (m) and speed limit (m/s) of the proposed zone: it is seen to work, and fails no drive."""


class Presence(Registration):
    """The entry of one attempt's system, from `update` to the end of the context."""

    def __init__(self, plan: DrivePlan, scene: Scene, stack: Stack) -> None:
        super().__init__(self.system)
        self._plan = plan
        self._scene = scene
        self._stack = stack
        self._usable = True

    def system(self) -> System:
        """Return the system as it is now: a restarted process has another port and process id."""
        stack = self._stack
        ports = {name: stack.port(name) for name in (*SERVICES, AGENT)}
        urls = {name: f"http://{net.LOOPBACK}:{port}" for name, port in ports.items() if port is not None}
        urls |= {BROKER: stack.mqtt_url, ROUTER: stack.zenoh_endpoint}
        if self._scene.page_url:
            urls[PAGE] = self._scene.page_url
        credentials = stack.doors.file("console")
        return System(
            name=f"demo-{os.getpid()}",
            kind="demo",
            site=self._plan.site.site.id,
            urls=urls,
            pids={"demo": os.getpid(), **stack.pids()},
            token_file=str(stack.token_file),
            credentials_file=None if credentials is None else str(credentials),
            robots=[self._plan.robot],
            speed=self._scene.speed,
        )

    def update(self) -> None:
        """Keep the entry current; without a usable register, the demo runs on without one."""
        if not self._usable:
            return
        try:
            super().update()
        except FailedError as error:
            self._usable = False
            self._scene.log_event(f"other commands can't find this demo: {error}")

    def announce(self) -> None:
        """Tell people the addresses and a command to draw a zone, which works as it is printed."""
        if not self._usable:
            return
        system = self.system()
        name = _command()
        choice = f" --fog {system.name}" if len(registered()) > 1 else ""
        goal = self._plan.goal
        radius, speed = _SLOW_ZONE
        zone = f"--circle {goal.x:g},{goal.y:g},{radius:g} --kind speed-limit --speed {speed:g} --reason 'slowly here'"
        rest = ", ".join(f"{service} {system.urls[service]}" for service in SERVICES if service in system.urls)
        self._scene.log_event(f"REST: {rest}; token in {system.token_file}")
        self._scene.log_event(f"see the system: {name} status{choice}")
        self._scene.log_event(f"draw a zone: {name} zone add {zone}{choice}")
        self._scene.hint = f"operate it from another terminal: {name} status{choice}"


def _command() -> str:
    """Return how this command is started in the current folder."""
    try:
        root = checkout.root()
    except WrongUseError:
        return "fognav"  # installed without a checkout, on the PATH
    return "./fognav" if Path.cwd() == root else shlex.quote(str(root / "fognav"))
