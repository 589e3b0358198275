"""What requests that write a record beside zones have in common: ids in paths, conditions."""

from typing import Final, TypeVar

import msgspec

from fog_contracts.messages import Id
from fog_runtime.http import HttpProblem, ProblemError, expected_version
from fog_runtime.http.store_routes import must_be_new
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import IdempotencyError
from map_service.places import StoredPlace
from map_service.problems import ZONES_NOT_LOADED, MapProblem
from map_service.record_writer import ConflictError, RecordWriter
from map_service.site_map import StoredMap
from map_service.zone_times import MutedSource, SetOfZones

WRITES: Final = (IdempotencyError, ConflictError, StoreError)
"""What writes of records raise."""

R = TypeVar("R", SetOfZones, StoredPlace, MutedSource, StoredMap)


class Conditions:
    """The conditions of a request that writes one record, whose id comes from the path."""

    def __init__(  # headers are parameters
        self, writer: RecordWriter[R], record_id: str, if_match: str | None, if_none_match: str | None, *, exists: bool
    ) -> None:
        """Read the headers; `exists`: whether people see such a record. Raises `ConflictError`."""
        self.expected = expected_version(if_match)
        self.new = not exists
        stored = writer.records.get(record_id)
        if not exists and self.expected is not None:
            raise ConflictError("missing", record_id, writer.table.name)
        if must_be_new(if_none_match):
            if exists:
                raise ConflictError("exists", record_id, writer.table.name)
            self.expected = 0 if stored is None else stored.version

    @property
    def status(self) -> int:
        """The status of the answer to a change that was made."""
        return 201 if self.new else 200


def missing(code: MapProblem) -> list[MapProblem]:
    """Return the problems of a route that needs a record."""
    return [code, *ZONES_NOT_LOADED]


def check_id(name: str) -> None:
    """Raise a `ProblemError` for an id in a path that is none."""
    try:
        msgspec.convert(name, Id)
    except msgspec.ValidationError as error:
        detail = f"{name!r} is no valid id: use a to z, 0 to 9 and -, at most 32"
        raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="path") from error
