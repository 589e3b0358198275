"""REST under /api/v1: areas with their state, history, overrides and alerts, and the health of nodes.

Reading needs no token, a change an operator's.
"""

import asyncio
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any

import msgspec
from fastapi import FastAPI

from fog_contracts.cones import seen_share
from fog_contracts.geometry import GeometryError, Point, normalized_polygon
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    Alert,
    AlertPolicy,
    AreaDefinition,
    AreaHazard,
    AreaState,
    Code,
    FreeWidth,
    FusionPolicy,
    Id,
    Message,
    Penalty,
    Ring,
    Source,
    UnknownPolicy,
)
from fog_contracts.site import NodeSite
from fog_runtime.clock import Clock
from fog_runtime.health import Health
from fog_runtime.http import (
    Answer,
    Body,
    HttpProblem,
    IfMatch,
    Operator,
    ProblemError,
    Routes,
    Tokens,
    etag,
    expected_version,
    make_app,
)
from fog_runtime.http.store_routes import (
    IdempotencyKey,
    IfNoneMatch,
    PageSize,
    add_recovery,
    add_store_errors,
    attempt_of,
    must_be_new,
    next_page,
)
from fog_runtime.stores.records import CursorError
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import IdempotencyError
from hazard_aggregator.alerts import AlertError
from hazard_aggregator.api_overrides import OverrideView, add_overrides, add_undo, override_view
from hazard_aggregator.area_size import AreaError, TooManyAreasError, check_size
from hazard_aggregator.history import PeriodView
from hazard_aggregator.problems import AreaProblem, no_such_area
from hazard_aggregator.service import Service
from hazard_aggregator.writers import ConflictError


def add_alerts(routes: Routes, service: Service) -> None:
    """Add the routes of alerts."""
    add_store_errors(routes)
    routes.raises(AlertError, [AreaProblem.NO_ALERT], lambda error: ProblemError(AreaProblem.NO_ALERT, str(error)))

    @routes.get("/api/v1/alerts")
    async def alerts() -> list[Alert]:
        """Return the active alerts, oldest first: areas and nodes that people should look after.

        Those that began, ended or were acknowledged earlier are in the audit trail (kind `alert`).
        """
        return service.alerts.active()

    @routes.put("/api/v1/alerts/{alert_id}/acknowledgement", raises=[AlertError, StoreError])
    async def acknowledge(alert_id: str, caller: Operator) -> Alert:
        """Record that somebody looks after an alert; it stays until its condition ends."""
        return await service.alerts.acknowledge(alert_id, caller.name)


def add_history(routes: Routes, service: Service, clock: Clock) -> None:
    """Add the route that reads histories; `routes` knows the errors of the store."""
    routes.raises(
        CursorError,
        [HttpProblem.REQUEST_INVALID],
        lambda error: ProblemError(HttpProblem.REQUEST_INVALID, str(error), field="query.cursor"),
    )

    @routes.get("/api/v1/areas/{area_id}/history", raises=[CursorError, StoreError], problems=[AreaProblem.NO_AREA])
    async def area_history(area_id: str, limit: PageSize, cursor: str | None = None) -> Answer[list[PeriodView]]:
        """Return an area's states and how long each lasted, newest first; the Link header has the next page's address.

        A period continues over restarts. The history goes back by 90 days, and 3,000 periods.
        """
        if not any(known.id == area_id for known in service.core.definitions()):
            raise no_such_area(area_id)
        page = await service.history.page(area_id, cursor, limit, Moment(clock.now(), clock.stamp(), clock=clock.id))
        return Answer(page.periods, next_page(f"/api/v1/areas/{area_id}/history", page.next, limit))


class AreaBody(Message, frozen=True, kw_only=True):
    """The part of an area that an operator sets: its polygon (m, frame `map`), or the node whose cone it is.

    With `cone_of`, one of `nodes`, the polygon is what that node's sonars see, and must not be given.
    """

    label: Annotated[str, msgspec.Meta(max_length=100)] = ""
    polygon: Ring | None = None
    cone_of: Id | None = None
    nodes: list[Id] = msgspec.field(default_factory=list)
    sources: Annotated[list[Source], msgspec.Meta(max_length=50)] = msgspec.field(default_factory=list)
    number: Annotated[int, msgspec.Meta(ge=0, le=9999)] | None = None
    debounce: dict[str, Any] = msgspec.field(default_factory=dict)
    fusion: FusionPolicy = FusionPolicy()
    unknown: UnknownPolicy = UnknownPolicy()
    alerts: AlertPolicy = AlertPolicy()
    penalty: Penalty | None = None
    free_width: FreeWidth | None = None
    removed: bool = False


class AreaView(Message, frozen=True, kw_only=True):
    """An area with its announced hazard; `withheld`: a newer hazard, a relief, is not announced until it is stored.

    `override` is an operator's state of it, which counts instead of the nodes'. `seen_share`: on which share of its
    free floor (0 to 1) its nodes would notice something half a metre wide; null where no node of the site watches it.
    """

    definition: AreaDefinition
    hazard: AreaHazard | None
    withheld: bool
    override: OverrideView | None
    seen_share: float | None


class NodeView(Message, frozen=True, kw_only=True):
    """Health of a node or source; `age_s` is the time since its last message, null before the first one.

    `code` identifies the reason (`NodeCode`).
    """

    id: str
    area: str
    state: AreaState
    reason: str
    code: Code
    online: bool | None
    age_s: float | None
    received: int
    ignored: int


def make_api(
    service: Service,
    static: StaticMap,
    clock: Clock,
    health: Health,
    tokens: Tokens,
    standby: Callable[[], str] = str,
) -> FastAPI:
    """Return the app over a running service; areas must lie on this map.

    While `standby` returns a reason, nothing can be written.
    """
    app = make_app("Fognav hazard-aggregator", health, tokens, standby=standby)
    areas = Routes(app, "areas")
    _add_areas(areas, service, static, clock)
    add_history(areas, service, clock)
    add_undo(areas, service, clock)
    _add_nodes(Routes(app, "nodes"), service, clock)
    add_alerts(Routes(app, "alerts"), service)
    recovery = Routes(app, "store")
    add_store_errors(recovery)
    add_recovery(recovery, service.records)
    return app


class _SeenShares:
    """What `AreaView.seen_share` says of each area: computed once for a polygon and its nodes, since it takes 2 ms."""

    def __init__(self, static: StaticMap) -> None:
        self._static = static
        self._known: dict[str, tuple[AreaDefinition, float | None]] = {}

    def of(self, definitions: Iterable[AreaDefinition], nodes: Mapping[str, NodeSite]) -> dict[str, float | None]:
        """Return the shares by area."""
        self._known = {each.id: self._kept(each) or (each, self._computed(each, nodes)) for each in definitions}
        return {area: share for area, (_, share) in self._known.items()}

    def _kept(self, definition: AreaDefinition) -> tuple[AreaDefinition, float | None] | None:
        kept = self._known.get(definition.id)
        same = kept is not None and (kept[0].polygon, kept[0].nodes) == (definition.polygon, definition.nodes)
        return kept if same else None

    def _computed(self, definition: AreaDefinition, nodes: Mapping[str, NodeSite]) -> float | None:
        watching = [nodes[name] for name in definition.nodes if name in nodes]
        return round(seen_share(definition.polygon, watching, self._static), 3) if watching else None


def _add_areas(routes: Routes, service: Service, static: StaticMap, clock: Clock) -> None:
    shares = _SeenShares(static)
    add_store_errors(routes)
    routes.raises(
        ConflictError,
        [AreaProblem.AREA_CHANGED],
        lambda error: ProblemError(AreaProblem.AREA_CHANGED, str(error)),
    )
    routes.raises(
        TooManyAreasError,
        [AreaProblem.TOO_MANY_AREAS],
        lambda error: ProblemError(AreaProblem.TOO_MANY_AREAS, error.problem, field="path"),
    )

    async def area_views() -> dict[str, AreaView]:
        seen = await asyncio.to_thread(shares.of, service.core.definitions(), service.core.nodes)
        announced, withheld, now = service.core.announced(), service.core.withheld(), clock.now()
        return {
            d.id: AreaView(
                definition=d,
                hazard=announced.get(d.id),
                withheld=d.id in withheld,
                override=override_view(service, d.id, now),
                seen_share=seen.get(d.id),
            )
            for d in service.core.definitions()
            if not d.removed
        }

    @routes.get("/api/v1/areas")
    async def list_areas() -> list[AreaView]:
        """List all areas with their state."""
        return list((await area_views()).values())

    @routes.get("/api/v1/areas/{area_id}", problems=[AreaProblem.NO_AREA])
    async def get_area(area_id: str) -> Answer[AreaView]:
        """Return one area with its ETag."""
        view = (await area_views()).get(area_id)
        if view is None:
            raise no_such_area(area_id)
        return Answer(view, etag(view.definition.version))

    @routes.put(
        "/api/v1/areas/{area_id}",
        status=(200, 201),
        raises=[ConflictError, IdempotencyError, StoreError, TooManyAreasError],
        problems=[AreaProblem.AREA_INVALID, AreaProblem.NO_NODE],
    )
    async def put_area(
        area_id: str,
        body: Body[AreaBody],
        caller: Operator,
        if_match: IfMatch = None,
        if_none_match: IfNoneMatch = None,
        idempotency_key: IdempotencyKey = None,
    ) -> Answer[AreaDefinition]:
        """Add or replace an area; replies once it is durably stored.

        With If-Match, only if it is unchanged; with `If-None-Match: *`, only if there is none.
        """
        known = next((area for area in service.core.definitions() if area.id == area_id), None)
        definition = await service.areas.put_area(
            _validated(area_id, body, service, static.geometry),
            caller.name,
            expected=expected_version(if_match),
            must_be_new=must_be_new(if_none_match),
            attempt=attempt_of(idempotency_key, caller, f"PUT /api/v1/areas/{area_id}", body),
        )
        return Answer(definition, etag(definition.version), status=201 if known is None or known.removed else 200)

    add_overrides(routes, service, clock)


def _add_nodes(routes: Routes, service: Service, clock: Clock) -> None:
    @routes.get("/api/v1/nodes")
    async def nodes() -> list[NodeView]:
        """Return the health of every node and source in each area that it watches."""
        return [
            NodeView(
                id=node.id,
                area=node.area,
                state=node.state,
                reason=str(node.reason),
                code=node.reason.code,
                online=node.online,
                age_s=node.age,
                received=node.received,
                ignored=node.ignored,
            )
            for node in service.core.node_reports(clock.now())
        ]


def _validated(area_id: str, body: AreaBody, service: Service, geometry: GridGeometry) -> AreaDefinition:
    for index, node in enumerate(body.nodes):
        if node not in service.core.nodes:
            detail = f"the site has no node {node}: add it to site.toml first, with its position and range limits"
            raise ProblemError(AreaProblem.NO_NODE, detail, field=f"body.nodes.{index}")
    try:
        polygon = _polygon(area_id, body, service, geometry)
        fields = {**msgspec.to_builtins(body), "id": area_id, "polygon": polygon}
        definition = service.core.checked(msgspec.convert(fields, AreaDefinition))
        check_size(definition)
    except msgspec.ValidationError as error:  # the id comes from the path
        detail = f"{area_id!r} is no valid id: use a to z, 0 to 9 and -, at most 32"
        raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="path") from error
    except AreaError as error:
        raise ProblemError(AreaProblem.AREA_INVALID, error.problem, field=f"body.{error.field}") from error
    return definition


def _polygon(area_id: str, body: AreaBody, service: Service, geometry: GridGeometry) -> list[Point]:
    """Return where an area is: its polygon, or what the sonars of the node see whose cone it is."""
    if body.cone_of is not None:
        if body.polygon is not None:
            detail = f"the area has a polygon, too, and is the cone of {body.cone_of}: leave out one of them"
            raise ProblemError(AreaProblem.AREA_INVALID, detail, field="body.cone_of")
        return service.core.cone(area_id, body.cone_of, body.nodes)
    if body.polygon is None:
        detail = "an area needs a place: draw a polygon, or name one of its nodes in cone_of"
        raise ProblemError(AreaProblem.AREA_INVALID, detail, field="body.polygon")
    try:
        polygon = normalized_polygon(body.polygon)
    except GeometryError as error:
        detail = f"{error}; draw a simple polygon"
        raise ProblemError(AreaProblem.AREA_INVALID, detail, field="body.polygon") from error
    for index, (x, y) in enumerate(polygon):
        if not geometry.contains(x, y):
            left, bottom, right, top = geometry.bounds
            reach = f"the map reaches from ({left:.2f}, {bottom:.2f}) to ({right:.2f}, {top:.2f}) m"
            detail = f"({x:.2f}, {y:.2f}) lies off the map: {reach}"
            raise ProblemError(AreaProblem.AREA_INVALID, detail, field=f"body.polygon.{index}")
    return polygon
