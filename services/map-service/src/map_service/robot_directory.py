"""Which robots are alive, and where Prometheus finds the metrics of each: what its service discovery asks for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_contracts.messages import Message

if TYPE_CHECKING:
    from fog_contracts.messages import RobotState

ALIVE_S: Final = 15.0
"""How long a robot counts as alive after its last state: three scrapes, so that a short gap of the Wi-Fi hides none."""


class ScrapeTarget(Message, frozen=True, kw_only=True):
    """A target in the form of Prometheus's HTTP service discovery: one address (host:port), and the robot's id."""

    targets: list[str]
    labels: dict[str, str]


class RobotDirectory:
    """The robots that were heard of lately, by id; times are those of the caller's monotonic clock (s)."""

    def __init__(self) -> None:
        self._heard: dict[str, tuple[float, str]] = {}

    def heard(self, robot: str, state: RobotState, now: float) -> None:
        """Remember a robot's state; forget robots that have been silent."""
        self._heard[robot] = now, state.metrics
        self._heard = {name: entry for name, entry in self._heard.items() if now - entry[0] <= ALIVE_S}

    def targets(self, now: float) -> list[ScrapeTarget]:
        """Return the robots that are alive and serve metrics, ordered by id."""
        return [
            ScrapeTarget(targets=[address], labels={"robot": robot})
            for robot, (at, address) in sorted(self._heard.items())
            if address and now - at <= ALIVE_S
        ]
