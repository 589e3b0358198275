"""What a base reports that must stop its wheels. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from robot_agent.hardware import BaseStatus

OVERCURRENT_S: Final = 0.3
"""A motor that starts on a carpet draws a high current for a moment; a blocked one keeps drawing it."""
_BUMP: Final = "the bumper is pressed"


def fault_of(status: BaseStatus, blocked_for: float, *, bumper: bool) -> str | None:
    """Return the fault that an awake base reports; None without one.

    blocked_for: s for which a motor has been drawing too much current. bumper: whether a pressed one is a fault now.
    """
    # A base may leave its driving mode by itself on cliff or wheel drop, which are the more precise reason.
    if status.cliff:
        return "a cliff sensor sees no floor"
    if status.wheel_drop:
        return "a wheel has dropped: the robot was lifted or hangs over an edge"
    if status.bumper and bumper:
        both = status.bumper_left and status.bumper_right
        side = "both sides" if both else "left" if status.bumper_left else "right"
        return f"{_BUMP} ({side})"
    if blocked_for >= OVERCURRENT_S:
        return "a wheel motor draws too much current: it is blocked"
    if status.mode_problem is not None:
        return f"the base left its driving mode: {status.mode_problem}"
    return None


def is_bump(fault: str) -> bool:
    """Return whether a fault is that of a pressed bumper."""
    return fault.startswith(_BUMP)
