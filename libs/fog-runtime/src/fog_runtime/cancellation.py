"""Cancellations that got lost on their way through a library."""

from __future__ import annotations

import asyncio


def raise_if_cancelled() -> None:
    """Go on with a cancellation of the current task that a library swallowed, or replaced by an error of its own.

    Libraries do so when they disconnect while they are cancelled, and `asyncio.wait_for` (Python 3.11) when its wait
    ends at that moment. A loop that went on would never end, nor would its process.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError
