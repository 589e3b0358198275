"""The history of an area: periods of one state each, as Redis keeps them and as people read them. Pure."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from fog_contracts.messages import AreaState, Message

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import AreaHazard

RETENTION_S: Final = 90 * 86_400.0
"""A period that ended longer ago than this (s) is forgotten."""
MAX_PERIODS: Final = 3_000
"""About so many periods of an area are kept."""


class Period(Message, frozen=True, kw_only=True):
    """A time in which an area had one state and penalty, and one operator's override or none (`overridden`).

    `began` is s since the epoch, `cause` what was said then, with `code` and `decided_by` as in `AreaHazard`.
    """

    began: float
    state: AreaState
    penalty: int
    cause: str
    overridden: bool
    code: str = ""
    decided_by: str | None = None


class StoredPeriod(Period, frozen=True, kw_only=True):
    """A period as it is stored: with when it began by a clock that nobody sets (`Moment.now`), and by which one.

    Without `uptime` it is known by the time of day only.
    """

    clock: int = 0
    uptime: float | None = None

    @property
    def shown(self) -> Period:
        """The period as people read it."""
        return Period(**{name: getattr(self, name) for name in Period.__struct_fields__})


class PeriodView(Message, frozen=True, kw_only=True):
    """A period with its end (s since the epoch; null: it is the present one) and how long (s) it has lasted.

    Steps of the clock change no duration as long as the computer was not restarted meanwhile: a period ends when its
    duration is over after its beginning, whatever the clock said then.
    """

    period: Period
    ended: float | None
    lasted_s: float


class HistoryPage(NamedTuple):
    """Periods, newest first, and the cursor of the next page; None on the last one."""

    periods: list[PeriodView]
    next: str | None


def period_of(hazard: AreaHazard, at: Moment | None) -> StoredPeriod:
    """Return the period that a hazard begins at this moment; None: when its state began, in an earlier run."""
    return StoredPeriod(
        began=hazard.since if at is None else at.stamp,
        clock=0 if at is None else at.clock,
        uptime=None if at is None else at.now,
        state=hazard.state,
        penalty=hazard.penalty,
        cause=hazard.cause,
        overridden=hazard.override is not None,
        code=hazard.code,
        decided_by=hazard.decided_by,
    )


def sameness(period: Period) -> str:
    """Return a text that two periods share if nothing changed between them but the words, as over a restart."""
    return f"{period.state} {period.penalty} {period.overridden}"


def page_of(found: Sequence[tuple[str, bytes]], *, cursor: str | None, limit: int, at: Moment) -> HistoryPage:
    """Return a page of `limit` periods at this moment.

    `found` are ids and records, newest first, from the last period of the page before (`cursor`) on: it tells when the
    next one ended. One more than a page has tells that there is another.
    """
    if cursor is not None and (not found or found[0][0] != cursor):
        return HistoryPage([], None)  # forgotten meanwhile, with all that was older
    periods = [msgspec.json.decode(data, type=StoredPeriod) for _, data in found]
    now = StoredPeriod(
        began=at.stamp, state="unknown", penalty=0, cause="", overridden=False, clock=at.clock, uptime=at.now
    )
    views = [] if cursor is not None or not periods else [_view(periods[0], now, ended=False)]
    views += [_view(older, newer, ended=True) for newer, older in pairwise(periods)]
    last = limit - 1 if cursor is None else limit
    return HistoryPage(views[:limit], found[last][0] if len(views) > limit else None)


def _view(period: StoredPeriod, until: StoredPeriod, *, ended: bool) -> PeriodView:
    """Return a period as people read it, which lasted until another one began, or `until` is now."""
    lasted_s = max(0.0, _seconds_between(period, until))
    return PeriodView(period=period.shown, ended=period.began + lasted_s if ended else None, lasted_s=lasted_s)


def _seconds_between(begin: StoredPeriod, end: StoredPeriod) -> float:
    """Return the time between two beginnings: of the clock that nobody sets, if it ran on between them."""
    if begin.uptime is not None and end.uptime is not None and begin.clock == end.clock:
        return end.uptime - begin.uptime
    return end.began - begin.began
