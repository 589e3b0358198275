"""Notices that a lidar repeats its scans: a working one never does.

Apart from `robot_agent.hardware`, which the guardian imports, too: digests bring a library of cryptography with them
that takes 3.7 MB of memory.
"""

from __future__ import annotations

import hashlib
from collections import deque
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_REMEMBERED_SCANS: Final = 64


class RepeatCounter:
    """Counts how many scans in a row repeat earlier ones, from the raw fields that a driver decoded.

    The last 64 scans are remembered by their digests: noise never repeats a scan, a replayed buffer of up to 64 does.
    """

    def __init__(self) -> None:
        self._digests: deque[bytes] = deque(maxlen=_REMEMBERED_SCANS)
        self._repeats = 1

    def count(self, *fields: NDArray[np.generic]) -> int:
        """Return 1 for a new scan; for one that equals an earlier one, 1 more than for the scan before it."""
        digest = hashlib.blake2b(digest_size=16)
        for field in fields:
            digest.update(field.tobytes())
        self._repeats = self._repeats + 1 if digest.digest() in self._digests else 1
        self._digests.append(digest.digest())
        return self._repeats
