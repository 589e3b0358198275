"""What the REST interfaces of all services with a store have in common: errors, recovery, idempotency, pages."""

from typing import Annotated, Any, Literal, Protocol
from urllib.parse import urlencode

import msgspec
from fastapi import Depends, Header, Query

from fog_contracts.messages import Message
from fog_runtime.http.problems import RETRY_AFTER, HttpProblem, ProblemError
from fog_runtime.http.routes import Body, Routes
from fog_runtime.http.tokens import Admin, Caller, Viewer
from fog_runtime.stores.redis_connection import StoreError, StoreRefusedError
from fog_runtime.stores.redis_store import Attempt, IdempotencyError, RecoveryError, StoreStatus
from fog_runtime.stores.undo import UndoError


def _page_size(
    limit: Annotated[int, Query(description="The most entries of a page: at least 1 and at most 1000 count")] = 100,
) -> int:
    return max(1, min(limit, 1000))


PageSize = Annotated[int, Depends(_page_size)]
"""The parameter `limit`, brought into its bounds before it is passed on."""


def next_page(path: str, cursor: str | None, limit: int, **query: str | None) -> dict[str, str]:
    """Return the Link header with the next page's address; none without a cursor."""
    if cursor is None:
        return {}
    given = {**query, "cursor": cursor, "limit": limit}
    address = urlencode({name: value for name, value in given.items() if value is not None})
    return {"Link": f'<{path}?{address}>; rel="next"'}


IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=128,
        pattern=r"^[\x21-\x7e]+$",
        description="Any text of your own, new for each change: a repeated request with it returns the first result"
        " and changes nothing, for 24 hours",
    ),
]
IfNoneMatch = Annotated[
    str | None, Header(alias="If-None-Match", description="`*`: refuse the request if the record exists already")
]


class Recovery(Message, frozen=True, kw_only=True):
    """What to do after Redis lost records: `restore` what the service has in memory, or `accept` what Redis has."""

    action: Literal["restore", "accept"]


class Recoverable(Protocol):
    """A service that can recover its store."""

    async def store_status(self) -> StoreStatus:
        """Return what Redis and the service have; raises `StoreError`."""

    async def recover_store(self, action: Literal["restore", "accept"], who: str) -> None:
        """Carry out an administrator's decision; raises `RecoveryError` and `StoreError`."""


def attempt_of(key: str | None, caller: Caller, target: str, body: Any) -> Attempt | None:  # noqa: ANN401  # any message
    """Return the attempt that an Idempotency-Key identifies; None without one. `target` is the method and path."""
    return None if key is None else Attempt.of(caller.name, key, target, body)


def must_be_new(if_none_match: str | None) -> bool:
    """Return whether an If-None-Match header asks for a new record; raises `ProblemError` for any value but `*`."""
    if if_none_match not in (None, "*"):
        detail = "send `If-None-Match: *`, or leave it out"
        raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="header.If-None-Match")
    return if_none_match is not None


def add_store_errors(routes: Routes) -> None:
    """Register the problem documents of the store's errors."""
    routes.raises(StoreError, [HttpProblem.STORE_AWAY, HttpProblem.STORE_UNCERTAIN], _problem)
    routes.raises(
        IdempotencyError,
        [HttpProblem.KEY_REUSED],
        lambda error: ProblemError(HttpProblem.KEY_REUSED, str(error), field="header.Idempotency-Key"),
    )


class UndoBody(Message, frozen=True, kw_only=True):
    """Which change is to be undone: the name of its entry in the audit trail."""

    entry: Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,16}-[0-9]{1,16}\.[a-z]+$(?!\n)")]


class Undone(Message, frozen=True, kw_only=True):
    """A record after an undo; `value` is null if there is none any more."""

    kind: str
    id: str
    value: msgspec.Raw


def add_undo_errors(routes: Routes) -> None:
    """Register the problem documents of changes that can't be undone."""
    codes = {code.value: code for code in (HttpProblem.NO_ENTRY, HttpProblem.NOT_UNDOABLE, HttpProblem.CHANGED_SINCE)}

    def convert(error: UndoError) -> ProblemError:
        later = error.later
        if later is None:
            return ProblemError(codes[error.code], str(error), field="body.entry")
        return ProblemError(
            codes[error.code], str(error), field="body.entry",
            by=later.who, action=later.action, at=later.at, entry=later.entry,
        )  # fmt: skip

    routes.raises(UndoError, list(codes.values()), convert)


def undone(kind: str, name: str, value: Message | None) -> Undone:
    """Return the answer to an undo: the record as it is now, None if it was removed."""
    return Undone(kind=kind, id=name, value=msgspec.Raw(msgspec.json.encode(value)))


def add_recovery(routes: Routes, service: Recoverable) -> None:
    """Add the route by which an administrator decides what happens after Redis lost records."""
    routes.raises(
        RecoveryError,
        [HttpProblem.NOTHING_LOST],
        lambda error: ProblemError(HttpProblem.NOTHING_LOST, str(error)),
    )

    @routes.get("/api/v1/store", raises=[StoreError])
    async def store_status(_caller: Viewer) -> StoreStatus:
        """Whether Redis lost acknowledged records; how many it has, and how many this service has in memory."""
        return await service.store_status()

    @routes.post("/api/v1/store/recovery", raises=[StoreError, RecoveryError])
    async def recover_store(body: Body[Recovery], caller: Admin) -> None:
        """Decide what happens after Redis lost acknowledged records: restore them from memory, or accept the loss."""
        await service.recover_store(body.action, caller.name)


def _problem(error: StoreError) -> ProblemError:
    if isinstance(error, StoreRefusedError):
        return ProblemError(HttpProblem.STORE_AWAY, f"nothing was changed: {error}", headers=RETRY_AFTER)
    return ProblemError(
        HttpProblem.STORE_UNCERTAIN,
        f"the change may or may not be stored: repeat the request, with its Idempotency-Key if it had one ({error})",
        headers=RETRY_AFTER,
    )
