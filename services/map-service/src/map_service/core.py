"""The map-service's decisions: which inputs change the map, whether areas count as clear, when the map is served.

Pure: every input comes with its `Moment`, and everything to be published is returned. The layers handle the messages
(`map_service.layers`), the costmap turns their changes into versions (`map_service.costmap`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.costs import DEFAULT_INFLATION
from fog_contracts.handlers import Moment, Publication
from fog_contracts.messages import HazardArea, MapDelta, Message, PlaceSet, ZoneSet
from map_service.applied import Applied
from map_service.costmap import COMMIT_CELLS, LayeredCostmap
from map_service.dry_run import Hypothesis
from map_service.layers.hazards import HazardsLayer
from map_service.layers.zones import ZonesLayer
from map_service.zone_times import StoredState

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.costs import Inflation
    from fog_contracts.grid import StaticMap
    from fog_contracts.handlers import Handler, Ids, Later, QueryHandler
    from fog_contracts.messages import AreaDefinition, MapSnapshot, Place, RobotState, Target, Zone
    from fog_contracts.shapes import Spans
    from map_service.aggregator_monitor import AggregatorMonitor
    from map_service.dry_run import Change
    from map_service.layers.base import CostLayer, Grid
    from map_service.zone_times import Progress, SetOfZones, SetSwitches
    from map_service.zones import PreparedZone, ZoneCatalog

ALIVE_S: Final = 15.0
"""How long a robot counts as alive after its last state: three scrapes, so that a short gap of the Wi-Fi hides none."""


class ScrapeTarget(Message, frozen=True, kw_only=True):
    """A target in the form of Prometheus's HTTP service discovery: one address (host:port), and the robot's id."""

    targets: list[str]
    labels: dict[str, str]


class RobotDirectory:
    """The robots that were heard of lately, by id; times are those of the caller's monotonic clock (s)."""

    def __init__(self) -> None:
        self._heard: dict[str, tuple[float, str]] = {}

    def heard(self, robot: str, state: RobotState, now: float) -> None:
        """Remember a robot's state; forget robots that have been silent."""
        self._heard[robot] = now, state.metrics
        self._heard = {name: entry for name, entry in self._heard.items() if now - entry[0] <= ALIVE_S}

    def targets(self, now: float) -> list[ScrapeTarget]:
        """Return the robots that are alive and serve metrics, ordered by id."""
        return [
            ScrapeTarget(targets=[address], labels={"robot": robot})
            for robot, (at, address) in sorted(self._heard.items())
            if address and now - at <= ALIVE_S
        ]


L = TypeVar("L", bound="CostLayer")

NOTHING_STORED: Final = StoredState()
SWITCHED_CELLS: Final = 16 * COMMIT_CELLS
"""Sets of zones are switched in one version of the map as long as their zones' windows have no more cells in all."""
MANY_ZONES: Final = 200
MANY_ZONES_PERIOD_S: Final = 0.5
"""More zones than MANY_ZONES are published at most once in this time: they are a message of up to 4 MiB."""


class MapCore:
    """The map-service's core; nothing is published before the map is complete (`serving`).

    `layers` are bottom first and include a `HazardsLayer` and a `ZonesLayer` (`map_service.registry`).
    `definitions` is a list of the site's areas, which are unknown until the aggregator publishes their hazards.
    `hazards_wait_s` is how long the map waits, from the first tick on, for the hazards of all areas.
    """

    def __init__(  # noqa: PLR0913  # everything that the map consists of, by name
        self,
        site: str,
        static: StaticMap,
        epoch: int = 0,
        inflation: Inflation = DEFAULT_INFLATION,
        *,
        layers: Sequence[CostLayer],
        definitions: Iterable[AreaDefinition] = (),
        hazards_wait_s: float = 0.0,
    ) -> None:
        self._layers = layers
        self._hazards = _find_layer(layers, HazardsLayer)
        self._zones = _find_layer(layers, ZonesLayer)
        for definition in definitions:
            self._hazards.define(definition, Moment(0.0, 0.0))
        self.costmap = LayeredCostmap(site, static, layers, inflation, epoch)
        self.robots = RobotDirectory()
        self.applied = Applied()
        self.places: Mapping[str, Place] = {}
        """All places by id (`put_places`)."""
        self._zones_loaded = False
        self._hazards_wait_s = hazards_wait_s
        self._serving = False
        self._zones_published_at = -math.inf
        self._first_tick: float | None = None

    # --- State ------------------------------------------------------------------------------------------------------

    @property
    def serving(self) -> bool:
        """Whether the map is complete, so that it is published and queries are answered."""
        return self._serving

    @property
    def pending(self) -> bool:
        """Whether a large change is only partly on the map: `continue_commit` puts the next portion on it."""
        return self.costmap.pending

    @property
    def zones_loaded(self) -> bool:
        """Whether the stored zones are on the map."""
        return self._zones_loaded

    def missing(self) -> str:
        """Return what must arrive before the map is served; empty when nothing is missing."""
        if not self._zones_loaded:
            return "the stored zones are not loaded yet"
        if not self._serving:
            return f"waiting for the hazards of {', '.join(self._hazards.areas_without_hazard()) or 'no area'}"
        return ""

    @property
    def zones(self) -> ZoneCatalog:
        """All zones."""
        return self._zones.catalog

    @property
    def refused_cells(self) -> int:
        """How many cells layers did not take, because they hold as many as they may."""
        return sum(layer.refused for layer in self._layers)

    def zone_set(self) -> ZoneSet:
        """Return all zones, and which of them are in force, with the map version that contains them."""
        version, zones = self.costmap.version, self.zones
        return ZoneSet(epoch=version.epoch, seq=version.seq, zones=zones.zones(), active=zones.active())

    @property
    def aggregator(self) -> AggregatorMonitor:
        """What the map knows about the aggregator."""
        return self._hazards.aggregator

    def hazards(self) -> list[HazardArea]:
        """Return every area with its hazard."""
        epoch = self.costmap.version.epoch
        return [structs.replace(area, epoch=epoch) for area in self._hazards.hazards()]

    # --- Channels ---------------------------------------------------------------------------------------------------

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handler of every channel that a layer subscribes to."""
        subscribed: dict[Channel, list[Handler]] = {}
        for layer in self._layers:
            for channel, handler in layer.handlers().items():
                subscribed.setdefault(channel, []).append(handler)
        combined = {channel: self._combined(handlers) for channel, handlers in subscribed.items()}
        return {ch.ROBOT_STATE: self._on_state, **combined}

    def query_handlers(self) -> Mapping[Channel, QueryHandler]:
        """Return the handler of every query; queries are answered once the map is served."""
        return {ch.MAP_SNAPSHOT: self._answer_snapshot, ch.ZONES: self._answer_zones, ch.HAZARD: self._answer_hazard}

    def tick(self, at: Moment) -> list[Publication]:
        """Activate and end zones, expire obstacles, check the aggregator's heartbeat; call ten times a second."""
        if self._first_tick is None:
            self._first_tick = at.now
        publications = [publication for layer in self._layers for publication in layer.tick(at)]
        publications = self._commit(publications, at)
        requests = self._hazards.requests(at)
        if not self._serving:
            if not self._is_complete(at.now):
                return requests
            self._serving = True
            publications = self._everything()
        return [*requests, *publications, Publication(ch.MAP_HEARTBEAT, self.costmap.heartbeat(at.now, at.clock))]

    # --- Leading and standing by: one of several map-services leads, the others follow all inputs -------------------

    def lead(self, epoch: int) -> list[Publication]:
        """Continue with this epoch; return hazards and zones again. Readers fetch the map itself."""
        self.costmap.set_epoch(epoch)
        self.applied.restart(self.costmap.version)
        return self._everything() if self._serving else []

    # --- Inputs without a channel -----------------------------------------------------------------------------------

    def load_zones(self, zones: Iterable[Zone], at: Moment, stored: StoredState = NOTHING_STORED) -> list[Publication]:
        """Replace the map's zones by the stored ones; raises `ShapeError`, and changes nothing, for an invalid one."""
        self._zones.replace_all(zones, at, stored)
        self._zones_loaded = True
        return self._commit([], at)

    def zone_progress(self, boot: str, now: float) -> dict[str, Progress]:
        """Return, by id, what must be stored of the times of zones; `boot` identifies the run of the clock."""
        return self._zones.progress(boot, now)

    def zones_over(self, seconds: float, now: float) -> list[Zone]:
        """Return the zones that have been over for so long (s), which will never be in force again."""
        return self._zones.over(seconds, now)

    def put_zone(self, zone: Zone, at: Moment, spans: Spans | None = None) -> list[Publication]:
        """Add or replace a stored zone, whose cells may be given; raises `ShapeError` for an invalid shape."""
        self._zones.put(zone, at, spans)
        return self._commit([], at)

    def remove_zone(self, zone_id: str, at: Moment) -> list[Publication]:
        """Remove a zone that is not stored any more."""
        self._zones.remove(zone_id)
        return self._commit([], at)

    def switched(self, sets: Mapping[str, bool], at: Moment) -> tuple[list[PreparedZone], list[str]]:
        """Return which zones would come into force, and which would end, if sets of zones were switched on or off."""
        return self._zones.switched(sets, at)

    def hypothesis(self, change: Change, targets: Sequence[Target] = ()) -> Hypothesis:
        """Return the map after a change that nobody makes; raises `RefusedMessageError` for an unknown area."""
        return Hypothesis(self.costmap, self._zones, self._hazards, change, targets)

    def write_zones(self, cost: Grid, speed: Grid) -> None:
        """Combine the zones in force into grids of the map's size."""
        self._zones.update_costs(self.costmap.geometry.whole, cost, speed)

    @property
    def zone_sets(self) -> SetSwitches:
        """The sets of zones, and which of them are off."""
        return self._zones.switches

    def put_zone_sets(self, sets: Mapping[str, SetOfZones], at: Moment) -> list[Publication]:
        """Replace the sets of zones; those that they switch change the map in one version (`SWITCHED_CELLS`)."""
        self._zones.put_sets(sets, at)
        return self._commit([], at)

    def put_places(self, places: Mapping[str, Place]) -> list[Publication]:
        """Replace the places."""
        self.places = places
        return [self._place_set()] if self._serving else []

    def continue_commit(self, at: Moment) -> list[Publication]:
        """Put the next portion of a large change on the map; call it while there is one (`pending`)."""
        return self._commit([], at)

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _combined(self, handlers: Sequence[Handler]) -> Handler:
        def handle(ids: Ids, message: object, at: Moment) -> list[Publication]:
            return self._commit([p for handler in handlers for p in handler(ids, message, at)], at)

        return handle

    def _on_state(self, ids: Ids, state: RobotState, at: Moment) -> list[Publication]:
        """Note that the robot is alive; the epochs that it received are passed on by the edges."""
        self.robots.heard(ids["robot"], state, at.now)
        self.applied.heard(ids["robot"], state, at)
        return []

    def _commit(self, publications: list[Publication], at: Moment) -> list[Publication]:
        """Make a version of the layers' changes; return its deltas and all publications, once the map is served.

        A large change is made in several versions; zones are published when the last one is made.
        """
        for publication in publications:
            if isinstance(publication.message, HazardArea):
                for layer in self._layers:
                    layer.on_area(publication.message, at)
        together = 0 < self._zones.pop_switched() <= SWITCHED_CELLS
        cells = COMMIT_CELLS if self._serving and not together else None
        deltas = [Publication(ch.MAP_DELTA, delta) for delta in self.costmap.update(at.stamp, cells)]
        self._note_changes(deltas, at.stamp)
        if not self._serving:
            self._zones.pop_changed()
            return []
        return [*deltas, *self._with_epoch(publications), *self._changed_zones(at.now)]

    def _note_changes(self, deltas: Sequence[Publication], stamp: float) -> None:
        """Note which changes are completely on the map now; a zone may have changed without changing any cell."""
        causes = [
            c for p in deltas if isinstance(p.message, MapDelta) and p.message.part == 0 for c in p.message.causes
        ]
        for cause in causes:
            if cause.kind == "hazard":
                self.applied.changed("hazard", cause.id, cause.state, self.costmap.version, stamp)
        if not self.costmap.pending:
            for name, state in self.zones.pop_touched().items():
                self.applied.changed("zone", name, state, self.costmap.version, stamp)

    def _changed_zones(self, now: float) -> list[Publication]:
        """Return the publication of the zones when they changed and are on the map; many of them not too often."""
        too_soon = len(self.zones) > MANY_ZONES and now < self._zones_published_at + MANY_ZONES_PERIOD_S
        if self.costmap.pending or too_soon or not self._zones.pop_changed():
            return []
        self._zones_published_at = now
        return [Publication(ch.ZONES, self.zone_set())]

    def _everything(self) -> list[Publication]:
        hazards = self._with_epoch(self._hazards.publications())
        return [*hazards, Publication(ch.ZONES, self.zone_set()), self._place_set()]

    def _place_set(self) -> Publication:
        return Publication(ch.PLACES, PlaceSet(epoch=self.costmap.version.epoch, places=dict(self.places)))

    def _with_epoch(self, publications: Iterable[Publication]) -> list[Publication]:
        """Return the layers' publications with the map's epoch."""
        epoch = self.costmap.version.epoch
        return [
            replace(p, message=structs.replace(p.message, epoch=epoch)) if isinstance(p.message, HazardArea) else p
            for p in publications
        ]

    def _is_complete(self, now: float) -> bool:
        """Whether zones and all hazards have arrived; areas whose hazard is missing after the wait are unknown."""
        waited = self._first_tick is not None and now - self._first_tick >= self._hazards_wait_s
        return self._zones_loaded and (waited or not self._hazards.areas_without_hazard())

    def _answer_snapshot(self, _ids: Ids, _request: None, _at: Moment) -> Later[MapSnapshot]:
        return self.costmap.snapshot_later()

    def _answer_zones(self, _ids: Ids, _request: None, _at: Moment) -> ZoneSet:
        return self.zone_set()

    def _answer_hazard(self, ids: Ids, _request: None, _at: Moment) -> HazardArea:
        return structs.replace(self._hazards.hazard(ids["area"]), epoch=self.costmap.version.epoch)


def _find_layer(layers: Iterable[CostLayer], kind: type[L]) -> L:
    for layer in layers:
        if isinstance(layer, kind):
            return layer
    raise ValueError(f"the map-service needs a {kind.__name__}: add it to the layers")
