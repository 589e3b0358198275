"""A robot's devices in the simulated world, as bytes on their two serial lines. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from fognav_sim.devices import BaseEmulator, LidarEmulator
    from fognav_sim.world import World

STEP_S: Final = 0.01
_BITS_PER_BYTE: Final = 10
"""8 data bits, start and stop bit."""
_BUFFER_BYTES: Final = 4096


class Line:
    """A serial line's pace: bytes go in at once and come out at the line's rate. Old ones are lost when it is full."""

    def __init__(self, baud: int) -> None:
        self._rate = baud / _BITS_PER_BYTE
        self._waiting = bytearray()
        self._credit = 0.0
        self.lost = 0

    def send(self, data: bytes, dt: float) -> bytes:
        """Take bytes to send; return those that the line carries in the `dt` seconds that passed."""
        self._waiting += data
        surplus = len(self._waiting) - _BUFFER_BYTES
        if surplus > 0:
            del self._waiting[:surplus]
            self.lost += surplus
        self._credit += self._rate * dt
        count = min(int(self._credit), len(self._waiting))
        # An idle line saves nothing up: the next byte takes its time.
        self._credit = self._credit - count if self._waiting[count:] else 0.0
        sent = bytes(self._waiting[:count])
        del self._waiting[:count]
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
        rolled: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Put the devices on the robot. `rolled` is how far (m) its wheels have rolled before: counters may wrap."""
        self.world = world
        self.now = start
        self.base = base
        self.lidar = lidar
        base.add_wheel_travel(*rolled)
        world.axle = base.axle_m
        self._base_line, self._lidar_line = Line(base.baud), Line(lidar.baud)

    @property
    def lost_bytes(self) -> int:
        """Bytes that the devices had to drop because the lines were too slow for them."""
        return self._base_line.lost + self._lidar_line.lost

    def receive(self, to_base: bytes, to_lidar: bytes) -> None:
        """Take what the host has written on both lines."""
        if to_base:
            self.base.receive(to_base, self.now)
        if to_lidar:
            self.lidar.receive(to_lidar, self.now)

    def step(self, dt: float = STEP_S) -> tuple[bytes, bytes]:
        """Let the world move on by `dt` seconds; return what base and lidar sent meanwhile."""
        world, base = self.world, self.base
        world.set_wheels(*base.wheel_speeds_m_s)
        base.add_wheel_travel(*world.step(dt))
        self.now += dt
        bump_left, bump_right = world.bumpers
        base.set_sensors(bump_left=bump_left, bump_right=bump_right, cliff=False)
        base.tick(self.now, dt)
        return (
            self._base_line.send(base.outgoing(self.now), dt),
            self._lidar_line.send(self.lidar.outgoing(self.now), dt),
        )
