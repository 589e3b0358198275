"""What a sensor node and a robot's electronics draw at 5 V, and how long a power bank lasts.

Run: python hardware/power.py [robot]. Estimated from data sheets; nothing here was measured. Put a USB meter between
supply and node or robot before you rely on it.
"""

import sys
from dataclasses import dataclass
from typing import Final

# ESP8266EX data sheet, table of the power consumption: currents at 3.3 V in mA. The board's linear regulator passes on
# the same current from 5 V.
CPU_MA: Final = 15.0
"""The processor runs and the radio sleeps between beacons (modem sleep)."""
LISTENING_MA: Final = 56.0
"""The processor runs and the radio receives (802.11n)."""
SENDING_MA: Final = 120.0
"""The processor runs and the radio sends (802.11n, 13 dBm)."""
# HC-SR04 data sheet.
SONAR_IDLE_MA: Final = 2.0
SONAR_MEASURING_MA: Final = 15.0

BOARD_MA: Final = 3.0
"""The regulator's own and the USB chip's; an estimate."""
AWAKE_S: Final = 0.1
"""How long the radio stays awake after it sent something; an estimate, access points differ."""
ON_AIR_S: Final = 0.002
"""One message with TLS, TCP and its acknowledgement, retries included; an estimate."""
BEACON_S: Final = (0.1024, 0.003)
"""The period of an access point's beacons, and how long the radio is awake for one."""
ECHO_S: Final = 0.020
"""A sonar's mean time per measurement: 3 m take 17 ms, no echo takes 38 ms."""
BANK_MAH: Final = 10_000
"""The capacity that is printed on a power bank: of its cells."""
CELL_V: Final = 3.7
SUPPLY_V: Final = 5.0
CONVERTER: Final = 0.85
"""The share that a power bank's converter leaves."""


@dataclass(frozen=True)
class Mode:
    """How a node publishes: its messages, and its readings, in 1/s."""

    name: str
    messages: float
    readings: float


MODES: Final = (Mode("heartbeat (default)", 1.0, 8.0), Mode("every reading (the thesis's)", 8.0, 8.0))


def terms(mode: Mode) -> list[tuple[str, float]]:
    """Return the parts of the mean current, each with its arithmetic and its value (mA); their sum is `current_ma`."""
    period, beacon = BEACON_S
    awake = min(1.0, mode.messages * AWAKE_S + beacon / period)
    sending = min(1.0, mode.messages * ON_AIR_S)
    measuring = mode.readings * ECHO_S
    return [
        (f"processor {CPU_MA:g}", CPU_MA),
        (f"board {BOARD_MA:g}", BOARD_MA),
        (
            (
                f"radio awake ({LISTENING_MA:g} - {CPU_MA:g}) * min(1, {mode.messages:g}/s * {AWAKE_S:g} s + "
                f"{beacon:g} s / {period:g} s)"
            ),
            (LISTENING_MA - CPU_MA) * awake,
        ),
        (
            f"radio sending ({SENDING_MA:g} - {LISTENING_MA:g}) * {mode.messages:g}/s * {ON_AIR_S:g} s",
            (SENDING_MA - LISTENING_MA) * sending,
        ),
        # One reading is one measurement by each of two sonars.
        (
            (
                f"two sonars 2 * ({SONAR_IDLE_MA:g} + ({SONAR_MEASURING_MA:g} - {SONAR_IDLE_MA:g}) * "
                f"{mode.readings:g}/s * {ECHO_S:g} s)"
            ),
            2 * (SONAR_IDLE_MA + (SONAR_MEASURING_MA - SONAR_IDLE_MA) * measuring),
        ),
    ]


def current_ma(mode: Mode) -> float:
    """Return the mean current (mA) at 5 V."""
    return sum(value for _, value in terms(mode))


def bank_hours(mode: Mode) -> float:
    """Return how long a full power bank lasts (h), if it does not switch itself off."""
    return BANK_MAH * CELL_V / SUPPLY_V * CONVERTER / current_ma(mode)


def table() -> str:
    """Return both modes as a Markdown table."""
    rows = [
        f"| {mode.name} | {current_ma(mode):.0f} mA | {current_ma(mode) * SUPPLY_V / 1000:.2f} W | "
        f"{current_ma(mode) * SUPPLY_V * 24 * 365 / 1e6:.1f} kWh | {bank_hours(mode) / 24:.1f} days |"
        for mode in MODES
    ]
    head = ("| publishing | mean current at 5 V | power | in a year | 10,000 mAh power bank |", "|---|---|---|---|---|")
    return "\n".join([*head, *rows])


def arithmetic() -> str:
    """Return the terms of each mode's current (mA), and of the life of a power bank, as Markdown."""
    return "\n".join(["```text", *(line for mode in MODES for line in _lines(mode)), "```"])


def _lines(mode: Mode) -> list[str]:
    return [
        f"{mode.name}, in mA:",
        *(f"  {value:5.1f}  {text}" for text, value in terms(mode)),
        f"  {current_ma(mode):5.1f}  together",
        (
            f"  {BANK_MAH:,} mAh * {CELL_V:g} V / {SUPPLY_V:g} V * {CONVERTER:g} / {current_ma(mode):.1f} mA = "
            f"{bank_hours(mode):.0f} h"
        ),
    ]


@dataclass(frozen=True)
class Load:
    """What a part of the robot draws at 5 V (mA): while the robot drives, while it rests, and at most."""

    name: str
    driving: float
    resting: float
    most: float


ROBOT: Final = (
    # Raspberry Pi's documentation: a bare Pi 4 typically draws 600 mA while active. At most: 7.2 W, which a published
    # test measured at the wall with all four cores busy; with its supply's loss the board has less.
    Load("Raspberry Pi 4, Wi-Fi on", 600.0, 540.0, 1440.0),
    # RPLIDAR A1M8 data sheet: core 300 typical and 350 at most, 600 when it starts, 80 asleep.
    Load("RPLidar A1, core", 300.0, 80.0, 600.0),
    # The same: 100 typical. A motor draws more until it turns: twice that is an estimate.
    Load("RPLidar A1, motor", 100.0, 0.0, 200.0),
    # FT232R data sheet: 15 in use; the lidar's adapter is estimated like it.
    Load("two USB serial adapters", 30.0, 30.0, 40.0),
)
"""What the power bank of a robot feeds. A resting Pi still runs all programs: a tenth less is an estimate."""
BANK_OF_ROBOT_MAH: Final = 20_000


def robot_table() -> str:
    """Return the robot's loads, their sum, and the hours of a full power bank, as a Markdown table."""
    rows = [*ROBOT, Load("**together**", *(sum(getattr(load, of) for load in ROBOT) for of in _STATES))]
    hours = [
        BANK_OF_ROBOT_MAH * CELL_V / SUPPLY_V * CONVERTER / value for value in (rows[-1].driving, rows[-1].resting)
    ]
    return "\n".join([
        "| part | drives | rests | at most |",
        "|---|---|---|---|",
        *(f"| {row.name} | {row.driving:.0f} mA | {row.resting:.0f} mA | {row.most:.0f} mA |" for row in rows),
        (
            f"| {BANK_OF_ROBOT_MAH:,} mAh power bank | {hours[0]:.0f} h | {hours[1]:.0f} h | "
            f"{rows[-1].most * SUPPLY_V / 1000:.0f} W |"
        ),
    ])  # fmt: skip


_STATES: Final = ("driving", "resting", "most")

if __name__ == "__main__":
    print(robot_table() if sys.argv[1:] == ["robot"] else f"{table()}\n\n{arithmetic()}")
