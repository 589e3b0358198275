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

PLACES: Final = (
    ("6.1", "default: the path leads into the blocked zone", "tracks.svg, orange: one drive, seen from above"),
    ("6.2", "full: the path avoids it", "tracks.svg, blue (full) and green (fog)"),
    ("6.3", "distance per route, simulated", "distance.svg, and the table below it"),
    ("6.4", "time per route, simulated", "time.svg, and the table below it"),
    ("6.5", "CPU of move_base, simulated", "cpu-move-base.svg, and the table below it"),
    ("6.6", "memory of move_base, simulated", "{memory}"),
    ("6.7", "distance per route, real", "distance.svg, as 6.3"),
    ("6.8", "time per route, real", "time.svg, as 6.4"),
    ("6.9", "CPU of move_base, real", "cpu-move-base.svg, as 6.5"),
    ("6.10", "memory of move_base, real", "{memory}"),
    ("6.11", "distance, simulated and real", "{distance}"),
    ("6.12", "time, simulated and real", "{time}"),
)
"""The thesis's figures of chapter 6: what each shows, and where a report has the same."""
MEMORY_UNKNOWN: Final = "only by real processes (fognav experiment --live): lockstep runs all setups in one"
REALITY_UNKNOWN: Final = "only by real processes (fognav experiment --live or --hardware)"
