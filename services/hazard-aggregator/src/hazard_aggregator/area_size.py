"""Checks that the messages about areas fit their channels before an area is stored. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError, encode
from fog_contracts.messages import AREAS_MAX, SENTENCE_MAX, AreaDefinition, AreaHazard, HazardOverride, Trace

if TYPE_CHECKING:
    from collections.abc import Iterable

_LARGEST: Final = 2**53
_LATEST: Final = 9_999_999_999.999999
_WIDEST: Final = "\N{GRINNING FACE}"
"""A character of four bytes in UTF-8."""


class AreaError(ValueError):
    """An area is invalid; the message names the area, the field, the problem and the remedy."""

    def __init__(self, area: str, field: str, problem: str) -> None:
        super().__init__(f"area {area}: {field}: {problem}")
        self.field = field
        self.problem = problem


class TooManyAreasError(AreaError):
    """There are as many areas as the aggregator's heartbeat, which lists all of them, can always hold."""


def excess(areas: Iterable[AreaDefinition]) -> str:
    """Return why there are too many areas for one heartbeat, and what to do; empty where there are not.

    Further ones are refused (`check_count`), but the site's file and the store can have more together. Without a
    heartbeat that lists all areas the map takes every one for unknown.
    """
    present = sum(not definition.removed for definition in areas)
    if present <= AREAS_MAX:
        return ""
    return (
        f"the site's file and the store have {present} areas together, and {AREAS_MAX} is the limit, above which all"
        f" may be unknown: remove {present - AREAS_MAX} (PUT them with `removed`), or make a part of the floor a site"
        " of its own"
    )


def check_count(definition: AreaDefinition, known: Iterable[AreaDefinition]) -> None:
    """Raise `TooManyAreasError` when an area would be one more than `AREAS_MAX` with the `known` ones."""
    present = {other.id for other in known if not other.removed}
    if definition.removed or definition.id in present or len(present) < AREAS_MAX:
        return
    problem = (
        f"the site has {len(present)} areas, and {AREAS_MAX} is the limit: remove one first (PUT it with `removed`),"
        " or make a part of the floor a site of its own"
    )
    raise TooManyAreasError(definition.id, "id", problem)


def check_size(definition: AreaDefinition) -> None:
    """Raise `AreaError` when the area's definition, or a hazard that names all of its nodes, would be too large."""
    # With the longest values that its other fields may have.
    hazard = AreaHazard(
        area=definition.id,
        state="unknown",
        severity=3,
        penalty=254,
        since=_LATEST,
        seq=_LARGEST,
        epoch=_LARGEST,
        cause=_WIDEST * SENTENCE_MAX,
        nodes=dict.fromkeys([*definition.nodes, *(source.id for source in definition.sources)], "unknown"),
        explained_by="x" * 32,
        override=HazardOverride(
            state="blocked",
            author=_WIDEST * 100,
            reason=_WIDEST * 200,
            set_at=_LATEST,
            ttl_s=1e9,
            measured="unknown",
            measured_penalty=254,
        ),
        trace=Trace(area=definition.id, epoch=_LARGEST, seq=_LARGEST, first_reading=_LATEST, confirmed=_LATEST),
        code="x" * 32,
        decided_by="x" * 32,
    )
    for channel, message in ((ch.AREA_DEFINITION, definition), (ch.AREA_HAZARD, hazard)):
        try:
            encode(channel, message)
        except ContractError as error:
            count = len(definition.nodes)
            problem = f"an area with {count} nodes is too large ({error}): split it into several areas"
            raise AreaError(definition.id, "nodes", problem) from error
