"""The emulated base and lidar of a robot, on ptys, in a simulated corridor; faults can be set at any time.

They run in a thread that waits for the bytes of the robot's guardian, so the moment at which a wheel was commanded
otherwise is known within a millisecond.
"""

from __future__ import annotations

import itertools
import select
import threading
import time
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, Self, cast

import numpy as np

from fognav_sim import devices
from fognav_sim.emulators import BaseEmulator, LidarEmulator
from fognav_sim.floor import Floor
from fognav_sim.hardware import STEP_S, Line
from fognav_sim.pty_port import PtyPort
from fognav_sim.sensors import LidarPlace
from fognav_sim.world import World

if TYPE_CHECKING:
    from pathlib import Path

    from fog_contracts.grid import StaticMap
    from fog_contracts.site import RobotSite

BASE: Final = "roomba600"
LIDAR: Final = "rplidar-a1"
_REMEMBERED: Final = 20_000
"""Changes of the commanded wheel speeds, some twenty a second."""


class _Sensors(Protocol):
    """What touches the emulated Roomba."""

    bump_left: bool
    bump_right: bool
    cliff_front_left: bool
    wheel_drop_left: bool
    overcurrent_left: bool


class FaultyBase(BaseEmulator, Protocol):
    """The emulated Roomba, as faults see it."""

    world: _Sensors


class FaultyLidar(LidarEmulator, Protocol):
    """The emulated RPLidar, as faults see it."""

    stalled: bool
    frozen: bool
    frozen_revolutions: int
    blind_sector_rad: tuple[float, float] | None


class Commanded(NamedTuple):
    """The speeds (left, right; m/s) at which the base is commanded to turn its wheels since a moment (s)."""

    since: float
    wheels: tuple[float, float]

    def exceeds(self, limit: float) -> bool:
        """Return whether the base is faster than this (m/s) at the middle of its axle, or turns a wheel if it is 0."""
        left, right = self.wheels
        return abs(left + right) / 2.0 > limit if limit else left != 0.0 or right != 0.0


def slower_after(commanded: list[Commanded], begun: float, limit: float) -> float | None:
    """Return how long (s) after `begun` the base was last commanded to exceed the limit; None if it still is."""
    last = begun
    for command, following in itertools.pairwise(commanded):
        if command.exceeds(limit):
            last = max(last, following.since)
    return None if commanded[-1].exceeds(limit) else last - begun


class Body:
    """The emulated robot; use it in a `with` statement, and change it under its `lock`."""

    def __init__(self, folder: Path, floor: StaticMap, robot: RobotSite, seed: int) -> None:
        self.base: FaultyBase = cast("FaultyBase", devices.make_base(BASE))
        self.world = World(Floor(floor.geometry, floor.cells), robot, seed, axle_m=self.base.axle_m)
        self.lidar: FaultyLidar = cast(
            "FaultyLidar", devices.make_lidar(LIDAR, partial(self.world.lidar_at, LidarPlace()))
        )
        self.base_link, self.lidar_link = folder / "base", folder / "lidar"
        self.lock = threading.Lock()
        self.noisy = False
        """Every frame of the base arrives damaged."""
        self._rng = np.random.default_rng(seed)
        self._base_port = PtyPort(self.base_link)
        self._lidar_port: PtyPort | None = PtyPort(self.lidar_link)
        self._lines = Line(self.base.baud), Line(self.lidar.baud)
        self._commanded = deque([Commanded(time.monotonic(), (0.0, 0.0))], maxlen=_REMEMBERED)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, name="body", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.set()
        self._thread.join()
        self._base_port.close()
        self.unplug_lidar()

    @property
    def wheels(self) -> tuple[float, float]:
        """Speeds (left, right; m/s) at which the base is commanded to turn its wheels."""
        return self.base.wheel_speeds_m_s

    def unplug_lidar(self) -> None:
        """Pull the lidar's cable: its device is gone."""
        if self._lidar_port is not None:
            self._lidar_port.close()
            self._lidar_port = None

    def plug_lidar(self) -> None:
        """Plug the lidar in again, if it is not."""
        if self._lidar_port is None:
            self._lidar_port = PtyPort(self.lidar_link)

    def slower_after(self, begun: float, limit: float) -> float | None:
        """Return how long (s) after `begun` the base was last commanded to be too fast; None if it still is.

        Too fast: faster than `limit` (m/s) at the middle of the axle, or, if the limit is zero, any wheel turning.
        """
        with self.lock:
            return slower_after(list(self._commanded), begun, limit)

    def _run(self) -> None:
        stepped_at = time.monotonic()
        while not self._ends.is_set():
            # Short, because the lidar's port may be closed meanwhile and is not waited for.
            select.select((self._base_port,), (), (), 0.002)
            with self.lock:
                now = time.monotonic()
                self._receive(now)
                if now - stepped_at >= STEP_S:
                    self._step(now, now - stepped_at)
                    stepped_at = now

    def _receive(self, now: float) -> None:
        if data := self._base_port.read():
            self.base.receive(data, now)
            self._record(now)
        if self._lidar_port is not None and (data := self._lidar_port.read()):
            self.lidar.receive(data, now)

    def _record(self, now: float) -> None:
        wheels = self.base.wheel_speeds_m_s
        if wheels != self._commanded[-1].wheels:
            self._commanded.append(Commanded(now, wheels))

    def _step(self, now: float, dt: float) -> None:
        self.world.set_wheels(*self.base.wheel_speeds_m_s)
        self.base.add_wheel_travel(*self.world.step(dt))
        self.base.tick(now, dt)
        self._record(now)
        to_host = self._lines[0].send(self.base.outgoing(now), dt)
        if self.noisy:
            to_host = bytes(byte ^ int(self._rng.integers(1, 256)) for byte in to_host)
        self._base_port.write(to_host)
        scan = self._lines[1].send(self.lidar.outgoing(now), dt)
        if self._lidar_port is not None:
            self._lidar_port.write(scan)
