"""What the agent asks of its hardware, each ability on its own.

Another base or another lidar is a new driver that offers these; the agent never asks for a model.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robot_agent.drivers.rplidar import Turn


@dataclass(frozen=True, slots=True)
class Feedback:
    """What a base last said of itself.

    received_at: arrival, seconds on the host's monotonic clock. x, y, theta: pose in the odometry frame, metres and
    radians, theta not wrapped. left_m_s, right_m_s: measured wheel speeds. charge_fraction: 0..1, nan if unknown.
    faults: what forbids driving, in words, empty when nothing does.
    """

    received_at: float
    x: float
    y: float
    theta: float
    left_m_s: float
    right_m_s: float
    charge_fraction: float
    faults: tuple[str, ...]


class Drive(Protocol):
    """A base with two driven wheels."""

    def command_wheels(self, left_m_s: float, right_m_s: float) -> None:
        """Ask for wheel speeds, m/s; they hold until the next call or until the driver judges them stale."""
        ...

    def feedback(self) -> Feedback | None:
        """Newest feedback, None before the first."""
        ...


class Scan(Protocol):
    """A scanner that looks all around."""

    def turns(self) -> Sequence[Turn]:
        """Whole turns that were completed since the last call, oldest first."""
        ...


class Dock(Protocol):
    """A base that can find its charger by itself."""

    def seek_dock(self) -> None:
        """Start docking; any wheel command ends it."""
        ...
