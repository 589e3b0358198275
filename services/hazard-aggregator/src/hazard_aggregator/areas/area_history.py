"""The history of an area: periods of one state each, as Redis keeps them and as people read them. Pure."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from fog_contracts.messages import AreaState, Message

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import AreaHazard

RETENTION_S: Final = 90 * 86_400.0
"""A period that ended longer ago than this (s) is forgotten."""
MAX_PERIODS: Final = 10_000
"""About so many periods of an area are kept."""


class Period(Message, frozen=True, kw_only=True):
    """A time in which an area had one state and penalty, and one operator's word or none (`overridden`).

    `began` is s since the epoch, `cause` what was said then.
    """

    began: float
    state: AreaState
    penalty: int
    cause: str
    overridden: bool


class PeriodView(Message, frozen=True, kw_only=True):
    """A period with its end (s since the epoch; null: it is the present one) and how long (s) it has lasted."""

    period: Period
    ended: float | None
    lasted_s: float


class HistoryPage(NamedTuple):
    """Periods, newest first, and the cursor of the next page; None on the last one."""

    periods: list[PeriodView]
    next: str | None


def period_of(hazard: AreaHazard, stamp: float) -> Period:
    """Return the period that a hazard begins at `stamp` (s since the epoch)."""
    return Period(
        began=stamp,
        state=hazard.state,
        penalty=hazard.penalty,
        cause=hazard.cause,
        overridden=hazard.override is not None,
    )


def sameness(period: Period) -> str:
    """Return a text that two periods share if nothing changed between them but the words, as over a restart."""
    return f"{period.state} {period.penalty} {period.overridden}"


def page_of(found: Sequence[tuple[str, bytes]], *, cursor: str | None, limit: int, now: float) -> HistoryPage:
    """Return a page of `limit` periods at `now` (s since the epoch).

    `found` are ids and records, newest first, from the last period of the page before (`cursor`) on: it tells when the
    next one ended. One more than a page has tells that there is another.
    """
    if cursor is not None and (not found or found[0][0] != cursor):
        return HistoryPage([], None)  # forgotten meanwhile, with all that was older
    periods = [msgspec.json.decode(data, type=Period) for _, data in found]
    views = [] if cursor is not None or not periods else [_view(periods[0], None, now)]
    views += [_view(older, newer.began, now) for newer, older in pairwise(periods)]
    last = limit - 1 if cursor is None else limit
    return HistoryPage(views[:limit], found[last][0] if len(views) > limit else None)


def _view(period: Period, ended: float | None, now: float) -> PeriodView:
    """Return a period as people read it; the clock may have been set back meanwhile."""
    lasted_s = max(0.0, (now if ended is None else ended) - period.began)
    return PeriodView(period=period, ended=ended if ended is None else period.began + lasted_s, lasted_s=lasted_s)
