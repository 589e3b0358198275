"""A simulated lift: `python -m fognav_sim.lift`, configured by FOGNAV_* environment variables.

It has a door of its own, takes its time, and serves one session at a time on all of its floors. It is connected with
each floor's router by itself: floors know nothing of one another.
"""

from __future__ import annotations

import math
import os
import tomllib
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts import channels as ch
from fog_contracts.messages import Id, LiftRequest, LiftState
from fog_runtime import logs, process
from fog_runtime.clock import SystemClock, ticker
from fog_runtime.configuration.settings import CommonSettings, SettingsError, describe, load
from fog_runtime.credentials import Credentials
from fog_runtime.health import Health, serve_health
from fog_runtime.transports.zenoh_edge import ZenohEdge

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.messages import DoorState, MotionState

PERIOD_S: Final = 0.5
DOOR_S: Final = 2.0
"""How long its door opens or closes."""
TRAVEL_S: Final = 4.0
"""How long it rides from one floor to the next."""
OPEN_S: Final = 5.0
"""So long its door stays open for a person, while no session keeps it open."""

_log = logs.get("sim")


class SimLift:
    """One lift; `now` is seconds of a monotonic clock."""

    def __init__(self, floors: Sequence[str], now: float = 0.0) -> None:
        """Stand at the first of the floors, which are in their order from below, with a closed door."""
        self._floors = list(floors)
        self._now = now
        self._at = 0.0
        """Which floor it is at; between two, their mean."""
        self._open = 0.0
        """How far its door is open (0 to 1)."""
        self._to = 0
        self._wanted_open = False
        self._opened_at = -OPEN_S
        self.session = ""

    def ask(self, request: LiftRequest, now: float) -> None:
        """Handle a request: another session's is ignored, as is one for a floor that it does not serve."""
        self.advance(now)
        if self.session not in ("", request.session_id) or request.destination_floor not in self._floors:
            return
        if request.request_type == "END_SESSION":
            if self.session:
                self.session, self._wanted_open, self._opened_at = "", False, now
            return
        self.session, self._to = request.session_id, self._floors.index(request.destination_floor)
        self._wanted_open = request.door_state == "OPEN"

    def advance(self, now: float) -> None:
        """Move door and cabin until `now`: it rides with its door closed only."""
        rest, self._now = max(0.0, now - self._now), now
        for_people = not self.session and now - self._opened_at < OPEN_S
        opens = self._wanted_open or for_people
        if self._open > 0.0 and not (opens and self._at == self._to):
            rest = self._turn_door(-rest)
        if self._open == 0.0 and self._at != self._to:
            way = self._to - self._at
            ridden = min(rest, abs(way) * TRAVEL_S)
            rest -= ridden
            there = ridden == abs(way) * TRAVEL_S
            self._at = float(self._to) if there else self._at + math.copysign(ridden / TRAVEL_S, way)
        if opens and self._at == self._to:
            self._turn_door(rest)

    def _turn_door(self, seconds: float) -> float:
        """Open the door for so long, or close it if that is negative; return the time that is left."""
        before = self._open
        self._open = min(1.0, max(0.0, before + seconds / DOOR_S))
        return max(0.0, abs(seconds) - abs(self._open - before) * DOOR_S)

    def state(self, now: float, stamp: float = 0.0) -> LiftState:
        """Return its state in Open-RMF's words."""
        self.advance(now)
        door: DoorState = "OPEN" if self._open == 1.0 else "CLOSED" if self._open == 0.0 else "MOVING"
        motion: MotionState = "STOPPED"
        if self._at != self._to and self._open == 0.0:
            motion = "UP" if self._to > self._at else "DOWN"
        return LiftState(
            available_floors=self._floors,
            current_floor=self._floors[round(self._at)],
            destination_floor=self._floors[self._to],
            door_state=door,
            motion_state=motion,
            current_mode="AGV" if self.session else "HUMAN",
            session_id=self.session,
            lift_time=stamp,
        )


class _Floor(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    zenoh_connect: str
    credentials: str = ""


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    floors: dict[Id, _Floor]


class Settings(CommonSettings, frozen=True, kw_only=True):
    """FOGNAV_LIFT: its id; FOGNAV_FLOORS_FILE: how it reaches each of its floors, from below."""

    site_dir: Path = Path()
    lift: Id
    floors_file: Path


def read_floors(file: Path) -> dict[str, tuple[list[str], Credentials]]:
    """Return the endpoints of each floor's router, and who the lift is there; raises `SettingsError`."""
    try:
        listed = msgspec.convert(tomllib.loads(file.read_text("utf-8")), _File).floors
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError, msgspec.ValidationError) as error:
        raise SettingsError(f"FOGNAV_FLOORS_FILE {file}: {error}. docs/campus.md has an example") from error
    return {
        floor: (
            [part.strip() for part in each.zenoh_connect.split(",")],
            Credentials.read(file.parent / each.credentials if each.credentials else None),
        )
        for floor, each in listed.items()
    }


async def main() -> None:
    """Simulate until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("sim", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    floors = read_floors(settings.floors_file)
    clock = SystemClock(settings.speed)
    lift, health = SimLift(list(floors), clock.now()), Health("zenoh")

    def ask(_ids: Mapping[str, str], request: LiftRequest) -> None:
        lift.ask(request, clock.now())

    async with AsyncExitStack() as stack:
        edges = [
            await stack.enter_async_context(
                ZenohEdge.open(
                    connect=endpoints, clock=clock, role="sim", id=settings.lift, site=floor, credentials=own
                )
            )
            for floor, (endpoints, own) in floors.items()
        ]
        for edge in edges:
            edge.subscribe(ch.LIFT_REQUEST, LiftRequest, ask, lift=settings.lift)
        stack.enter_context(serve_health(health, settings.http_host, settings.http_port, settings.port_file))
        health.set("zenoh", ok=True)
        async for now in ticker(clock, PERIOD_S):
            state = lift.state(now, clock.stamp())
            for edge in edges:
                edge.publish(ch.LIFT_STATE, state, lift=settings.lift)


if __name__ == "__main__":
    process.run(main)
