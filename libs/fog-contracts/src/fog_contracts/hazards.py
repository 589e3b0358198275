"""What aggregator and map-service must agree on about hazards: which change is a relief, and the digest of them all."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.messages import AreaHazard

_HASH_BITS = 63


def is_relief(hazard: AreaHazard, before: AreaHazard | None) -> bool:
    """Whether a hazard allows robots more than the one before (an area without one counts as forbidden)."""
    if before is None:
        return hazard.state == "clear"
    if hazard.penalty < before.penalty:
        return True
    return hazard.state == "clear" and before.state != "clear"


def digest(hazards: Iterable[AreaHazard]) -> int:
    """Return a 63-bit hash of the hazards' areas, seqs, states and penalties; their order does not matter."""
    lines = sorted(f"{h.area} {h.seq} {h.state} {h.penalty}" for h in hazards)
    whole = hashlib.blake2b("\n".join(lines).encode(), digest_size=8).digest()
    return int.from_bytes(whole, "big") >> (64 - _HASH_BITS)
