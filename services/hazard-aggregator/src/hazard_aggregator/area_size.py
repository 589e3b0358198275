"""Checks that an area's messages fit their channels before it is stored. Pure."""

from __future__ import annotations

from typing import Final

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError, encode
from fog_contracts.messages import SENTENCE_MAX, AreaDefinition, AreaHazard, HazardOverride, Trace

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
    )
    for channel, message in ((ch.AREA_DEFINITION, definition), (ch.AREA_HAZARD, hazard)):
        try:
            encode(channel, message)
        except ContractError as error:
            count = len(definition.nodes)
            problem = f"an area with {count} nodes is too large ({error}): split it into several areas"
            raise AreaError(definition.id, "nodes", problem) from error
