"""What a robot says of its battery and charger."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from fog_contracts.messages import Reason, ReasonCode

if TYPE_CHECKING:
    from robot_agent.hardware import BaseStatus

_STEP: Final = 0.05
"""The announced charge is rounded down to steps of this size."""


def power_warnings(status: BaseStatus | None, low: float) -> list[Reason]:
    """Return the reasons for which somebody should look after the battery; `low`: charge (of 1) that is too little."""
    if status is None:
        return []
    state = status.power.charging if status.power is not None else None
    warnings: list[Reason] = []
    if state == "fault":
        sentence = "the charger reports a fault: the battery does not charge"
        warnings.append(Reason(ReasonCode.CHARGER_FAULT, sentence))
    if status.battery is not None and status.battery < low and not status.charging:
        percent = round(100 * _STEP * math.floor(status.battery / _STEP + 1e-9))
        sentence = f"the battery is low ({percent} %): take the robot to its charger"
        warnings.append(Reason(ReasonCode.BATTERY_LOW, sentence))
    return warnings
