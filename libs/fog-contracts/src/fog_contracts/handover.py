"""Which floor of its building a robot is on: its own record decides, and floors hand it over (ADR 76). Pure.

Robot and floors keep the same kind of record (`Berth`), each by itself. The giving floor writes that the robot has left
it before the robot hears of it, the robot writes the new floor before it speaks there, and the receiving floor writes
that it is there before it sends it anywhere. No message passes between the floors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

from fog_contracts.messages import Berth, Reason, RefusalCode

if TYPE_CHECKING:
    from fog_contracts.messages import HandOver

Standing = Literal["here", "arrives", "leaves", "stale"]
"""What a floor makes of a robot that it hears: it is this floor's; it has just come; it was not told yet, or has not
understood, that it was handed over; its own record is older than the floor's, and it is sent nowhere."""

_ID: Final = 16
"""So many characters of a hand-over's id are its own; behind them is that of the one before."""


def id_after(before: str, own: str) -> str:
    """Return the id of a hand-over that follows the one with the id `before` (empty: none, or an unknown one)."""
    return own[:_ID] + before[:_ID]


def id_before(given: HandOver) -> str:
    """Return the id of the hand-over before; empty if there was none, or for an id of an older floor."""
    return given.id[_ID:]


def next_berth(berth: Berth, given: HandOver) -> Berth | Reason:
    """Return the record after a hand-over, the same one for one that is repeated; or why it does not follow."""
    after = Berth(floor=given.floor, epoch=given.epoch, came_by=given)
    if berth == after:
        return berth
    if given.origin != berth.floor or given.epoch != berth.epoch + 1 or given.floor == berth.floor:
        sentence = (
            f"the hand-over {given.epoch} from {given.origin} to {given.floor} does not follow: the robot is on "
            f"{berth.floor} by its hand-over {berth.epoch}"
        )
        return Reason(RefusalCode.OTHER_BERTH, sentence)
    return after


def standing(known: Berth | None, said: Berth, floor: str) -> Standing:
    """Return what a floor makes of a robot's record (`said`) by its own (`known`; None: it has none).

    A robot that was put back after its record was lost counts anew, and may come by an epoch of before: it is `stale`
    where it had left by the next one, for what it was told then is long done.
    """
    before = Berth(floor=floor) if known is None else known
    if said.floor != floor:
        return "stale"
    if said.epoch > before.epoch:
        return "arrives"
    if before.floor == floor:
        return "here" if said.epoch == before.epoch else "stale"
    follows = "" if before.came_by is None else id_before(before.came_by)
    came_by = "" if said.came_by is None else said.came_by.id
    return "leaves" if said.epoch == before.epoch - 1 and came_by.startswith(follows) else "stale"
