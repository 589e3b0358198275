"""REST of dry runs: what a change of zones or of areas' overrides would do, computed with the planner's help."""

import asyncio
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Final

import msgspec

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.handlers import RefusedMessageError
from fog_contracts.messages import DryRunOutcome, DryRunReply, Id, Message, OverrideState, Place, Target
from fog_contracts.site import Site
from fog_runtime.clock import Clock
from fog_runtime.concurrency import BusyError, Worker
from fog_runtime.http import RETRY_AFTER, Body, ProblemError, Routes, Viewer
from map_service.dry_run import Change, Hypothesis
from map_service.problems import MapProblem, require_zones
from map_service.service import Service
from map_service.zone_bodies import ZoneBody, zone_from_body
from map_service.zones import ZoneError

MOST_WAITING: Final = 4
"""Most dry runs that are computed or wait for it, one of each person."""
ATTEMPTS: Final = 5
"""How often a change is computed anew because the map has changed meanwhile."""
PAUSE_S: Final = 0.05
TIMEOUT_S: Final = 10.0


class DryRunBody(Message, frozen=True, kw_only=True):
    """A change that nobody makes: zones to add or replace, ids of zones to remove, sets of zones to switch on or off.

    And overrides of areas (null: end). `zones` count as in force, whatever their times and sets say, unless they are
    not enabled; those of `sets` as far as their times say so.
    """

    zones: Annotated[list[ZoneBody], msgspec.Meta(max_length=100)] = msgspec.field(default_factory=list)
    removed_zones: Annotated[list[Id], msgspec.Meta(max_length=100)] = msgspec.field(default_factory=list)
    sets: Annotated[dict[Id, bool], msgspec.Meta(max_length=100)] = msgspec.field(default_factory=dict)
    overrides: Annotated[dict[Id, OverrideState | None], msgspec.Meta(max_length=100)] = msgspec.field(
        default_factory=dict
    )


class _DryRuns:
    """Computes one dry run at a time."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._worker = Worker("dry runs", limit=1)
        self._lock = asyncio.Lock()
        self._callers: set[str] = set()

    @contextmanager
    def admitted(self, caller: str) -> Iterator[None]:
        """Admit one dry run of a caller; raises `BusyError` when one of theirs is computed, or too many wait."""
        if caller in self._callers or len(self._callers) >= MOST_WAITING:
            whose = "one of yours" if caller in self._callers else f"{len(self._callers)} of others"
            raise BusyError(f"a dry run is computed already, {whose}")
        self._callers.add(caller)
        try:
            yield
        finally:
            self._callers.discard(caller)

    async def outcome(self, change: Change, targets: list[Target]) -> DryRunOutcome:
        """Return what a change would do.

        Raises `RefusedMessageError` for an unknown area, and `ProblemError` when the planner has no answer.
        """
        async with self._lock:
            for _ in range(ATTEMPTS):
                reply = await self._ask(change, targets)
                if reply is None or reply.stale:
                    await asyncio.sleep(PAUSE_S)
                elif reply.outcome is not None:
                    return reply.outcome
                else:
                    reason = "it has no answer" if reply.refusal is None else reply.refusal.reason
                    raise ProblemError(MapProblem.PLANNER_AWAY, f"the planner: {reason}", headers=RETRY_AFTER)
        raise BusyError("the map changed again and again while the change was computed")

    async def _ask(self, change: Change, targets: list[Target]) -> DryRunReply | None:
        """Return the planner's reply; None when the map has changed before it was asked."""
        await self._service.publisher.all_on_map()
        hypothesis = self._service.core.hypothesis(change, targets)
        if not await _combined(hypothesis):
            return None
        request = await self._worker.run(hypothesis.request)
        try:
            reply = await self._service.zenoh.query(ch.PLANNER_DRY_RUN, request, DryRunReply, TIMEOUT_S)
        except ContractError as error:
            detail = f"{error.reason}: try fewer or smaller zones at a time"
            raise ProblemError(MapProblem.DRY_RUN_REFUSED, detail) from error
        if reply is None:
            detail = "the planner does not answer: see its /readyz, then try again"
            raise ProblemError(MapProblem.PLANNER_AWAY, detail, headers=RETRY_AFTER)
        return reply


async def _combined(hypothesis: Hypothesis) -> bool:
    """Combine the layers while other work of the event loop goes on; return whether the map has stayed the same."""
    for _ in hypothesis.combine():
        await asyncio.sleep(0)
        if not hypothesis.is_current:
            return False
    return hypothesis.is_current


def targets_of(known: Mapping[str, Place], site: Site) -> list[Target]:
    """Return the places that robots are sent to, and the fronts of their docks."""
    places = [Target(kind="place", id=name, at=(place.x, place.y)) for name, place in sorted(known.items())]
    docks = [Target(kind="dock", id=robot, at=(pose.x, pose.y)) for robot, pose in sorted(site.staging.items())]
    return [*places, *docks]


def add_dry_runs(routes: Routes, service: Service, site: Site, clock: Clock) -> None:
    """Add the route; `routes` knows the errors of zones."""
    dry_runs = _DryRuns(service)

    @routes.post(
        "/api/v1/dry-run",
        raises=[ZoneError, BusyError],
        problems=[
            MapProblem.ZONES_NOT_LOADED,
            MapProblem.UNKNOWN_ZONE,
            MapProblem.UNKNOWN_ZONE_SET,
            MapProblem.UNKNOWN_AREA,
            MapProblem.PLANNER_AWAY,
            MapProblem.DRY_RUN_REFUSED,
        ],
    )
    async def dry_run(body: Body[DryRunBody], caller: Viewer) -> DryRunOutcome:
        """Return what a change of zones or overrides would do to robots' paths and places, and change nothing.

        Times are estimates: lengths by the speeds that apply. One dry run at a time for each caller.
        """
        require_zones(service)
        _require_known(service, body)
        with dry_runs.admitted(caller.asker):
            change = await _change(service, body, caller.name, clock.stamp())
            try:
                return await dry_runs.outcome(change, targets_of(service.core.places, site))
            except RefusedMessageError as error:  # it was removed meanwhile
                raise ProblemError(MapProblem.UNKNOWN_AREA, str(error)) from error


def _require_known(service: Service, body: DryRunBody) -> None:
    """Raise a `ProblemError` when a body names something that there is not."""
    areas = {area.hazard.area for area in service.core.hazards()}
    zones = {f"removed_zones.{index}": name for index, name in enumerate(body.removed_zones)}
    unknown = [
        *((MapProblem.UNKNOWN_ZONE, f, "zone", n, "zones") for f, n in zones.items() if not service.core.zones.get(n)),
        *(
            (MapProblem.UNKNOWN_ZONE_SET, f"sets.{name}", "set of zones", name, "zone-sets")
            for name in body.sets
            if name not in service.core.zone_sets.sets
        ),
        *(
            (MapProblem.UNKNOWN_AREA, f"overrides.{name}", "area", name, "hazards")
            for name in body.overrides
            if name not in areas
        ),
    ]
    for code, field, what, name, route in unknown[:1]:
        detail = f"there is no {what} {name}: GET /api/v1/{route} lists those that there are"
        raise ProblemError(code, detail, field=f"body.{field}")


async def _change(service: Service, body: DryRunBody, author: str, stamp: float) -> Change:
    """Return the change that a body describes; raises `ZoneError` and `BusyError`."""
    prepared = []
    for index, zone in enumerate(body.zones):
        try:
            made = zone_from_body(zone, zone.id or f"new-{index}", author, stamp)
            prepared.append(await service.zones.prepare(made))
        except ZoneError as error:
            raise ZoneError(f"zones.{index}.{error.field}".rstrip("."), error.message) from error
    begin, end = service.core.switched(body.sets, service.zones.now()) if body.sets else ([], [])
    named = {*body.removed_zones, *(each.zone.id for each in prepared)}
    return Change(
        zones=[*prepared, *(each for each in begin if each.zone.id not in named)],
        removed=[*body.removed_zones, *(name for name in end if name not in named)],
        overrides=body.overrides,
    )
