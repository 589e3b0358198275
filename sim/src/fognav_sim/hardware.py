"""A robot's base and lidar in the simulated world, as bytes on their two serial lines. Pure."""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING, Final

from fognav_sim.emulators import DockingBase

if TYPE_CHECKING:
    from fog_contracts.messages import Pose
    from fognav_sim.emulators import BaseEmulator, LidarEmulator
    from fognav_sim.world import World

STEP_S: Final = 0.01
_BITS_PER_BYTE: Final = 10
"""8 data bits, start and stop bit."""
_BUFFER_BYTES: Final = 4096


class Line:
    """The rate of a serial line: bytes are queued and delivered at the line's rate; overflow drops the oldest.

    `lost` and `flipped`: share of the bytes that do not arrive, or with a wrong bit, in both directions, whose bytes do
    not wait for each other. While it is `stalled`, what the device sends waits, as in an adapter that hangs.
    """

    def __init__(self, baud: int, seed: int = 1) -> None:
        self._from_device, self._from_host = _Queue(baud), _Queue(baud)
        self.lost = self.flipped = 0.0
        self.stalled = False
        self._random = random.Random(seed)  # noqa: S311  # repeatable, not a secret

    @property
    def lost_bytes(self) -> int:
        """Bytes dropped because the line was too slow."""
        return self._from_device.lost_bytes + self._from_host.lost_bytes

    def send(self, data: bytes, dt: float) -> bytes:
        """Queue bytes of the device; return those that arrive at the host in `dt` seconds."""
        self._from_device.add(data)
        return b"" if self.stalled else self._disturb(self._from_device.take(dt))

    def receive(self, data: bytes) -> None:
        """Queue bytes of the host."""
        self._from_host.add(data)

    def deliver(self, dt: float) -> bytes:
        """Return the host's bytes that arrive at the device in `dt` seconds."""
        return self._disturb(self._from_host.take(dt))

    def _disturb(self, data: bytes) -> bytes:
        if self.lost == self.flipped == 0.0:
            return data
        arrived = bytearray()
        for byte in data:
            drawn = self._random.random()
            if drawn >= self.lost:
                arrived.append(byte ^ (1 << self._random.randrange(8)) if drawn < self.lost + self.flipped else byte)
        return bytes(arrived)


class _Queue:
    """The bytes of one direction that wait for the line."""

    def __init__(self, baud: int) -> None:
        self._rate = baud / _BITS_PER_BYTE
        self._queue = bytearray()
        self._credit = 0.0
        self.lost_bytes = 0

    def add(self, data: bytes) -> None:
        self._queue += data
        surplus = len(self._queue) - _BUFFER_BYTES
        if surplus > 0:
            del self._queue[:surplus]
            self.lost_bytes += surplus

    def take(self, dt: float) -> bytes:
        """Return what the line carries in `dt` seconds."""
        self._credit += self._rate * dt
        count = min(int(self._credit), len(self._queue))
        # An idle line accumulates no credit: the next byte takes its full time.
        self._credit = self._credit - count if count < len(self._queue) else 0.0
        sent = bytes(self._queue[:count])
        del self._queue[:count]
        return sent


class Hardware:
    """Base and lidar of the world's robot; `now` (s) moves with each step."""

    def __init__(
        self,
        world: World,
        base: BaseEmulator,
        lidar: LidarEmulator,
        start: float,
        *,
        initial_wheel_travel_m: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Mount base and lidar on the robot; its encoders begin after `initial_wheel_travel_m` (left, right)."""
        self.world = world
        self.now = start
        self.base = base
        self.lidar = lidar
        base.add_wheel_travel(*initial_wheel_travel_m)
        self.base_line, self.lidar_line = Line(base.baud), Line(lidar.baud)

    def receive(self, to_base: bytes, to_lidar: bytes) -> None:
        """Pass on what the host has written to both lines: it arrives during the next steps."""
        self.base_line.receive(to_base)
        self.lidar_line.receive(to_lidar)

    def step(self, dt: float = STEP_S) -> tuple[bytes, bytes]:
        """Simulate `dt` seconds; return the bytes that base and lidar sent meanwhile."""
        world, base = self.world, self.base
        if arrived := self.base_line.deliver(dt):
            base.receive(arrived, self.now)
        if arrived := self.lidar_line.deliver(dt):
            self.lidar.receive(arrived, self.now)
        world.set_wheels(*base.wheel_speeds_m_s)
        base.add_wheel_travel(*world.step(dt))
        self.now += dt
        bump_left, bump_right = world.bumpers
        base.set_sensors(bump_left=bump_left, bump_right=bump_right, cliff=world.over_cliff)
        if world.robot.dock is not None and isinstance(base, DockingBase):
            base.set_dock(*seen_from_dock(world.pose, world.robot.dock))
        base.tick(self.now, dt)
        return (
            self.base_line.send(base.outgoing(self.now), dt),
            self.lidar_line.send(self.lidar.outgoing(self.now), dt),
        )


def seen_from_dock(pose: tuple[float, float, float], dock: Pose) -> tuple[float, float, float]:
    """Return how far (m) a robot at `pose` has to go to its pose on the dock, how far aside, and its heading (rad)."""
    x, y, theta = pose
    cos, sin = math.cos(dock.theta), math.sin(dock.theta)
    dx, dy = x - dock.x, y - dock.y
    return -(dx * cos + dy * sin), dy * cos - dx * sin, math.remainder(theta - dock.theta, math.tau)
