"""What the map-service decides: which inputs change the map, whether areas count as clear, when the map is served.

Pure: every input comes with its `Moment`, and everything that is to be published is returned. The layers listen for
themselves (`map_service.layers`), the costmap turns what they changed into versions (`map_service.costmap`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from fog_contracts import channels as ch
from fog_contracts.costs import DEFAULT_INFLATION
from fog_contracts.handlers import Publication
from fog_contracts.messages import HazardArea, ZoneSet
from map_service.costmap import LayeredCostmap
from map_service.layers.hazards import HazardsLayer
from map_service.layers.zones import ZonesLayer

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from typing import Final

    from fog_contracts.channels import Channel
    from fog_contracts.costs import Inflation
    from fog_contracts.handlers import Handler, Ids, Moment, QueryHandler
    from fog_contracts.messages import AreaDefinition, MapSnapshot, Zone
    from map_service.costmap import StaticMap
    from map_service.layers.base import CostLayer

L = TypeVar("L", bound="CostLayer")

AGGREGATOR_LOST_S: Final = 3.0
"""How long (s) the aggregator, or the broker, may be gone until no area counts as clear any more."""


class MapCore:
    """The map-service's core; nothing is published before the map is whole (`serving`).

    `layers` are bottom first, with a `HazardsLayer` and a `ZonesLayer` among them (`map_service.registry`).
    `definitions` are areas known from the site: until the aggregator speaks of them they count as unknown.
    `hazards_wait_s` is how long the first tick's map waits for the hazards of all areas.
    """

    def __init__(  # noqa: PLR0913  # what the map is made of, each with its name
        self,
        site: str,
        static: StaticMap,
        epoch: int,
        inflation: Inflation = DEFAULT_INFLATION,
        *,
        layers: Sequence[CostLayer],
        definitions: Iterable[AreaDefinition] = (),
        hazards_wait_s: float = 0.0,
    ) -> None:
        self._layers = layers
        self._hazards = _only(layers, HazardsLayer)
        self._zones = _only(layers, ZonesLayer)
        for definition in definitions:
            self._hazards.define(definition)
        self.costmap = LayeredCostmap(site, static, layers, inflation, epoch)
        self._zones_read = False
        self._hazards_wait_s = hazards_wait_s
        self._serving = False
        self._first_tick: float | None = None
        self._aggregators: set[str] = set()
        self._broker_connected = False
        self._aggregator_lost_since: float | None = None

    # --- What it holds ----------------------------------------------------------------------------------------------

    @property
    def serving(self) -> bool:
        """Whether the map is whole and may be published and asked for."""
        return self._serving

    @property
    def zones_are_read(self) -> bool:
        """Whether the stored zones are on the map."""
        return self._zones_read

    def missing(self) -> str:
        """Say what the map waits for before it is served; empty when it waits for nothing."""
        if not self._zones_read:
            return "the zones are not read yet"
        if not self._serving:
            return f"waiting for the hazards of {', '.join(self._hazards.unheard()) or 'no area'}"
        return ""

    def zones(self) -> list[Zone]:
        """Return all zones by id."""
        return self._zones.zones()

    def active_zones(self) -> list[str]:
        """Return the ids of the zones that hold now."""
        return self._zones.active()

    def zone_set(self) -> ZoneSet:
        """Return all zones with the map version that shows them."""
        version = self.costmap.version
        return ZoneSet(epoch=version.epoch, seq=version.seq, zones=self.zones())

    def hazards(self) -> list[HazardArea]:
        """Return every area with its hazard."""
        return [p.message for p in self._hazards.publications() if isinstance(p.message, HazardArea)]

    # --- Channels ---------------------------------------------------------------------------------------------------

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handler of every channel that a layer listens to."""
        listening: dict[Channel, list[Handler]] = {}
        for layer in self._layers:
            for channel, handler in layer.handlers().items():
                listening.setdefault(channel, []).append(handler)
        return {channel: self._input(handlers) for channel, handlers in listening.items()}

    def query_handlers(self) -> Mapping[Channel, QueryHandler]:
        """Return who answers queries, once the map is served."""
        return {ch.MAP_SNAPSHOT: self._snapshot, ch.ZONES: self._zone_set, ch.HAZARD: self._hazard}

    def tick(self, at: Moment) -> list[Publication]:
        """Let zones begin and end, obstacles expire, clear areas become unknown; call ten times a second."""
        if self._first_tick is None:
            self._first_tick = at.now
        publications = self._check_aggregator_liveness(at)
        for layer in self._layers:
            publications += layer.tick(at)
        publications = self._commit(publications, at)
        if not self._serving:
            if not self._is_whole(at.now):
                return []
            self._serving = True
            publications = [*self._hazards.publications(), Publication(ch.ZONES, self.zone_set())]
        return [*publications, Publication(ch.MAP_HEARTBEAT, self.costmap.heartbeat(at.stamp))]

    # --- What no channel carries ------------------------------------------------------------------------------------

    def on_aggregator(self, name: str, at: Moment, *, alive: bool) -> list[Publication]:
        """Take that an aggregator came or went, by its liveliness token."""
        (self._aggregators.add if alive else self._aggregators.discard)(name)
        return self._commit(self._check_aggregator_liveness(at), at)

    def on_broker(self, at: Moment, *, connected: bool) -> list[Publication]:
        """Take whether the broker, which carries the aggregator's messages, is connected."""
        self._broker_connected = connected
        return self._commit(self._check_aggregator_liveness(at), at)

    def load_zones(self, zones: Iterable[Zone], at: Moment) -> list[Publication]:
        """Make the map's zones those that are stored; raises `ShapeError`, and changes nothing, for an unusable one."""
        self._zones.replace_all(zones, at.stamp)
        self._zones_read = True
        return self._commit([], at)

    def put_zone(self, zone: Zone, at: Moment) -> list[Publication]:
        """Add or replace a zone that is stored; raises `ShapeError` for a shape that can't be used."""
        self._zones.put(zone, at.stamp)
        return self._commit([], at)

    def remove_zone(self, zone_id: str, at: Moment) -> list[Publication]:
        """Forget a zone that is not stored any more."""
        self._zones.remove(zone_id)
        return self._commit([], at)

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _input(self, handlers: Sequence[Handler]) -> Handler:
        def handle(ids: Ids, message: object, at: Moment) -> list[Publication]:
            return self._commit([p for handler in handlers for p in handler(ids, message, at)], at)

        return handle

    def _commit(self, publications: list[Publication], at: Moment) -> list[Publication]:
        """Turn what the layers changed into a version; return its deltas with the reasons, once the map is served."""
        deltas = [Publication(ch.MAP_DELTA, delta) for delta in self.costmap.update(at.stamp)]
        zones = [Publication(ch.ZONES, self.zone_set())] if self._zones.take_changed() else []
        return [*deltas, *publications, *zones] if self._serving else []

    def _check_aggregator_liveness(self, at: Moment) -> list[Publication]:
        """Let areas count as clear only while an aggregator is alive, and the broker between is connected.

        An aggregator that has not appeared since the start counts as lost as one that left.
        """
        if self._aggregators and self._broker_connected:
            self._aggregator_lost_since = None
            return self._hazards.set_aggregator_lost(False)
        if self._aggregator_lost_since is None:
            self._aggregator_lost_since = at.now
        if at.now - self._aggregator_lost_since > AGGREGATOR_LOST_S:
            return self._hazards.set_aggregator_lost(True)
        return []

    def _is_whole(self, now: float) -> bool:
        """Whether the zones are read and every area was heard of; after the wait, the others count as unknown."""
        waited = self._first_tick is not None and now - self._first_tick >= self._hazards_wait_s
        return self._zones_read and (waited or not self._hazards.unheard())

    def _snapshot(self, _ids: Ids, _request: None, _at: Moment) -> MapSnapshot:
        return self.costmap.snapshot()

    def _zone_set(self, _ids: Ids, _request: None, _at: Moment) -> ZoneSet:
        return self.zone_set()

    def _hazard(self, ids: Ids, _request: None, _at: Moment) -> HazardArea:
        return next(described for described in self.hazards() if described.hazard.area == ids["area"])


def _only(layers: Iterable[CostLayer], kind: type[L]) -> L:
    for layer in layers:
        if isinstance(layer, kind):
            return layer
    raise ValueError(f"the map-service can't do without its {kind.__name__}: name it among the layers")
