"""What the thesis reports (Mendes 2022, chapter 6), as its text states it; its figures give no numbers."""

from __future__ import annotations

from typing import Final, NamedTuple


class Reported(NamedTuple):
    """A figure of the thesis: what it shows, in simulation (50 runs) and on the robot (10 runs)."""

    figures: str
    subject: str
    simulated: str
    real: str


REPORTED: Final = (
    Reported(
        "6.3, 6.7",
        "distance saved per route (default - full)",
        "around 80 m on each route",
        "around 70, 70 and 30 m",
    ),
    Reported(
        "6.4, 6.8",
        "time saved per route (default - full)",
        "around 20 s on each route",
        "60, 80 and 15 s",
    ),
    Reported(
        "6.5, 6.9",
        "CPU of move_base (default -> full)",
        "more than 175 % -> 25 to 50 % of a core (virtual machine)",
        "around 110 % -> around 20 % (Raspberry Pi 4)",
    ),
    Reported(
        "6.6, 6.10",
        "memory of move_base",
        "no difference",
        "more in full, for the layer that it adds",
    ),
    Reported(
        "(text)",
        "detection of a danger until it reaches the robot",
        "not measured",
        "around 3 s",
    ),
)
