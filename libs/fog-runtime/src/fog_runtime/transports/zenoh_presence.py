"""Asking a zenoh router who is present: which processes declared it with `declare_liveliness`, and are connected."""

from __future__ import annotations

import asyncio
import contextlib
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import zenoh

if TYPE_CHECKING:
    from fog_runtime.transports.zenoh_query import Threads

_GRACE_S: Final = 0.5
"""How much longer than asked for a question may take (real seconds): on a congested link, even asking may block."""


class Presence(NamedTuple):
    """The keys of those who are present; `complete`: the router has answered, and not only this process itself."""

    keys: set[str]
    complete: bool


async def ask_who_is_present(threads: Threads, session: zenoh.Session, keys: str, timeout_s: float) -> Presence:
    """Return who is present under these keys, as far as routers answer within `timeout_s` (real seconds)."""
    found: set[str] = set()
    failures: list[str] = []
    done = asyncio.Event()

    def on_reply(reply: zenoh.Reply) -> None:
        # zenoh reports a router that does not answer in time as the error "Timeout".
        if reply.ok is not None:
            threads.call(found.add, str(reply.ok.key_expr))
        else:
            threads.call(failures.append, "no answer")

    get = partial(
        session.liveliness().get,
        keys,
        zenoh.handlers.Callback(on_reply, lambda: threads.call(done.set)),
        timeout=timeout_s,
    )
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(timeout_s + _GRACE_S):
            await threads.in_thread(get)
            await done.wait()
    return Presence(found, complete=done.is_set() and not failures)
