"""Zones that systems of others put on the map over MQTT, and the sets that they switch (docs/sources.md).

A source's messages change its own zones only, within the limits that `site.toml` gives it. Whatever is refused is
counted, logged, and answered on the source's topic for problems.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

from msgspec import structs
from prometheus_client import Counter

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError, decode, decode_text
from fog_contracts.handlers import Publication
from fog_contracts.messages import Id, Message, Zone, ZoneRequest
from fog_runtime import logs
from fog_runtime.concurrency import BusyError, Worker
from fog_runtime.stores.redis_connection import StoreError
from map_service.record_writer import ConflictError
from map_service.zones import ZoneError, prepare_zone

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Moment
    from fog_contracts.site import Site, ZoneSourceSite
    from fog_runtime.transports.mqtt_edge import MqttEdge
    from map_service.core import MapCore
    from map_service.record_writer import RecordWriter
    from map_service.zone_times import MutedSource, SetOfZones
    from map_service.zone_writer import ZoneWriter

FORGET_S: Final = 1.0
"""Seconds for which whoever deletes a source's zone waits until the broker has forgotten it, too."""
RETRY_S: Final = 0.5
"""Seconds until a message is tried again that Redis, or too many others, kept from being carried out."""
MAX_PROBLEM: Final = 300
"""Characters of the longest problem: at most 4 bytes each."""
REFUSALS: Final = Counter(
    "fognav_zone_source_refusals_total", "Messages of sources of zones that were refused", ["source"]
)

_UNKNOWN: Final = "(unknown)"
_log = logs.get("zone_sources")


class ZoneSourceView(Message, frozen=True, kw_only=True):
    """A source of zones: what it has on the map, how many messages were refused since the start, the latest problem."""

    id: Id
    label: str
    muted: bool
    version: int
    zones: list[str]
    refused: int
    problem: str


class RefusedRequestError(ValueError):
    """A source asks for what it may not have; the text says what, and the remedy."""


class _Received(NamedTuple):
    """A message that waits to be carried out: of which source, and what it is about."""

    source: str
    channel: Channel
    subject: str
    payload: bytes
    retained: bool


@dataclass
class _Source:
    """A source with its limits, and a bucket of messages that it may send (`updated`: s, monotonic)."""

    site: ZoneSourceSite
    tokens: float
    updated: float
    refused: int = 0
    problem: str = field(default="")

    @property
    def burst(self) -> float:
        """Most messages at once: all its zones twice, as after a new connection."""
        return max(float(self.site.per_minute), 2.0 * self.site.max_zones)

    def take(self, now: float) -> bool:
        """Take a message out of the bucket; return whether there was one."""
        refilled = self.tokens + (now - self.updated) * self.site.per_minute / 60.0
        self.tokens, self.updated = min(self.burst, refilled), now
        if self.tokens < 1.0:
            return False
        self.tokens -= 1.0
        return True


class ZoneSources:
    """Carries out the messages of all sources, one after another, while this process leads."""

    def __init__(  # noqa: PLR0913  # the parts that it works with
        self,
        site: Site,
        core: MapCore,
        zones: ZoneWriter,
        sets: RecordWriter[SetOfZones],
        muted: RecordWriter[MutedSource],
        publish: Callable[[Sequence[Publication]], object],
        mqtt: MqttEdge,
    ) -> None:
        now = zones.now().now
        self._site = site.id
        self._sources = {source.id: _Source(source, 0.0, now) for source in site.zone_sources}
        for source in self._sources.values():
            source.tokens = source.burst
        self._core = core
        self._zones = zones
        self._sets = sets
        self._muted = muted
        self._publish = publish
        self._mqtt = mqtt
        self._forgotten: dict[tuple[str, str], Zone] = {}
        """Deleted zones that the broker may still retain, by source and id."""
        self._worker = Worker("zone-sources", limit=1)
        self._limited = logs.RateLimited(_log)
        self._waiting: dict[str, _Received] = {}
        self._arrived = asyncio.Event()
        self.leading = False

    # --- Receiving --------------------------------------------------------------------------------------------------

    async def listen(self) -> None:
        """Receive messages, and again those that the broker has retained."""
        self._forgotten.clear()  # another one may have led meanwhile
        if self._sources:
            topics = [channel.pattern(site=self._site) for channel in (ch.ZONE_REQUEST, ch.ZONE_SET_SWITCH)]
            await self._mqtt.listen_to_foreign(topics, self.receive, again=topics)

    def receive(self, topic: str, payload: bytes | None, retained: bool) -> None:  # noqa: FBT001  # a handler's signature
        """Take a message of a source (`payload` None: too long), to be carried out by `run`."""
        if not self.leading:
            return
        *_, about, kind, _ = topic.split("/")
        channel, name = (ch.ZONE_REQUEST, "zone") if kind == "zones" else (ch.ZONE_SET_SWITCH, "set")
        ids, source = channel.match(topic), self._sources.get(about)
        if source is None:
            REFUSALS.labels(_UNKNOWN).inc()
            remedy = "add it to zone_sources in site.toml, or remove its user"
            self._limited.warning("unknown_zone_source", "", self._zones.now().now, topic=topic, remedy=remedy)
            return
        removes = payload == b"" and channel is ch.ZONE_REQUEST
        if removes and ids is not None and not self._is_known(topic, ids["zone"]):
            return  # it is gone already: most often what this service has cleared itself
        if not source.take(self._zones.now().now):
            reason = f"more than {source.site.per_minute} messages a minute: send them less often; this one is lost"
        elif self._is_muted(source.site.id):
            reason = "an operator has muted this source: ask them to let it speak again"
        else:
            reason = ""
        if reason or ids is None or payload is None:
            wrong = "has a malformed id: use a to z, 0 to 9 and -" if ids is None else "had too long a message"
            self._refuse(source, topic, reason or f"the topic {topic[:100]!r} {wrong}")
            return
        self._waiting.pop(topic, None)  # what waited is overtaken, and the new message goes behind all others
        self._waiting[topic] = _Received(ids["source"], channel, ids[name], payload, retained)
        self._arrived.set()

    async def forget(self, zone: Zone) -> None:
        """Delete what the broker retains of a zone that its source did not delete; return once it has, or soon.

        An operator's may have been a source's before. A broker that is away may tell of a source's zone once more: that
        is passed over, and deleted then.
        """
        if zone.source:
            self._forgotten[zone.source, zone.id] = zone
        sources = [zone.source] if zone.source else [*self._sources]
        if clearing := [asyncio.create_task(self._clear(source, zone.id)) for source in sources]:
            await asyncio.wait(clearing, timeout=FORGET_S)

    async def _clear(self, source: str, zone: str) -> None:
        if await self._mqtt.clear(ch.ZONE_REQUEST, wait=True, source=source, zone=zone):
            self._forgotten.pop((source, zone), None)

    async def _is_forgotten(self, zone: Zone, *, retained: bool) -> bool:
        """Whether a message only tells again of a deleted zone; the broker is to forget it, then."""
        assert zone.source is not None
        deleted = self._forgotten.get((zone.source, zone.id))
        if deleted is not None and retained and structs.replace(zone, version=deleted.version) == deleted:
            await self.forget(deleted)
            return True
        self._forgotten.pop((zone.source, zone.id), None)  # its source has said something newer
        return False

    def views(self) -> list[ZoneSourceView]:
        """Return all sources."""
        zones = [zone for zone in self._core.zones.zones() if zone.source]
        return [
            ZoneSourceView(
                id=name,
                label=source.site.label,
                muted=self._is_muted(name),
                version=0 if (stored := self._muted.records.get(name)) is None else stored.version,
                zones=[zone.id for zone in zones if zone.source == name],
                refused=source.refused,
                problem=source.problem,
            )
            for name, source in self._sources.items()
        ]

    def _is_known(self, topic: str, zone_id: str) -> bool:
        return topic in self._waiting or self._core.zones.get(zone_id) is not None

    def _is_muted(self, source: str) -> bool:
        stored = self._muted.records.get(source)
        return stored is not None and stored.muted

    # --- Carrying out -----------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Carry out what arrives, for ever; what Redis keeps from being stored waits until it answers."""
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            while self._waiting:
                if not await self.carry_out_next():
                    await asyncio.sleep(RETRY_S)

    async def carry_out_next(self) -> bool:
        """Carry out the message that has waited longest; return False if it must be tried again."""
        topic, received = next(iter(self._waiting.items()))
        source = self._sources[received.source]
        try:
            if not self.leading:
                pass  # the one that leads has received it, too
            elif received.channel is ch.ZONE_SET_SWITCH:
                await self._switch(source.site, received)
            elif received.payload:
                await self._put(source.site, received)
            else:
                await self._remove(source.site, received)
        except (RefusedRequestError, ContractError, ZoneError) as error:
            self._refuse(source, topic, error.reason if isinstance(error, ContractError) else str(error))
        except (StoreError, BusyError):
            return False  # Redis is away, for all of them
        except ConflictError:
            # Somebody has changed the same at this moment: the others need not wait for it.
            if self._waiting.get(topic) is received:
                self._waiting[topic] = self._waiting.pop(topic)
            return False
        else:
            self._tell(source, "")
        if self._waiting.get(topic) is received:  # else it was overtaken meanwhile
            del self._waiting[topic]
        return True

    async def _put(self, source: ZoneSourceSite, received: _Received) -> None:
        at = self._zones.now()
        request = decode(ch.ZONE_REQUEST, received.payload, ZoneRequest)
        zone = _requested_zone(source, received, request, at)
        if zone.expires_at is not None and at.synchronized and zone.expires_at <= at.stamp and received.retained:
            await self.forget(zone)
            return
        if await self._is_forgotten(zone, retained=received.retained):
            return
        old = self._own_zone(source.id, zone.id)
        if old is not None and received.retained and structs.replace(zone, version=old.version) == old:
            return  # the broker tells it again
        prepared = await self._worker.run(
            prepare_zone, zone, self._core.costmap.geometry, at.stamp if at.synchronized else 0.0
        )
        area = prepared.spans.cells * self._core.costmap.geometry.resolution**2
        if area > source.max_area:
            raise RefusedRequestError(
                f"zone {zone.id} covers {area:.1f} m², and {source.max_area:g} is the limit: make it smaller"
            )
        if (why := self._zones.unusable.reasons.get(zone.id)) is not None:
            raise RefusedRequestError(
                f"zone {zone.id} is stored, but its record is invalid ({why}): an operator must delete it first"
            )
        who = _who(source.id)
        if old is not None:
            await self._zones.replace(zone, old.version, who)
            return
        others = sum(other.source == source.id for other in self._core.zones.zones())
        if others >= source.max_zones:
            raise RefusedRequestError(
                f"zone {zone.id} would be one too many: this source has {others}; remove one by an empty message"
            )
        await self._zones.create(zone, who)

    async def _remove(self, source: ZoneSourceSite, received: _Received) -> None:
        old = self._own_zone(source.id, received.subject)
        if old is not None:
            await self._zones.delete(old.id, old.version, _who(source.id))

    async def _switch(self, source: ZoneSourceSite, received: _Received) -> None:
        name, wanted = received.subject, decode_text(ch.ZONE_SET_SWITCH, received.payload)
        known = self._sets.records.get(name)
        if name not in source.sets or known is None:
            may = ", ".join(each for each in source.sets if each in self._sets.records) or "none"
            raise RefusedRequestError(f"this source can't switch a set {name}; it may switch: {may}")
        if received.retained:
            raise RefusedRequestError(f"set {name}: the message is retained, and may be old: send it without retain")
        if wanted not in ch.ZONE_SET_SWITCH.values:
            raise RefusedRequestError(f"set {name}: {wanted!r} is neither on nor off")
        enabled = wanted == ch.ON
        if known.enabled != enabled:
            await self._sets.put(structs.replace(known, enabled=enabled), known.version, _who(source.id))

    def _own_zone(self, source: str, zone_id: str) -> Zone | None:
        """Return a zone that the source may change, None if there is none; raises `RefusedRequestError`."""
        entry = self._core.zones.get(zone_id)
        if entry is not None and entry.zone.source != source:
            raise RefusedRequestError(f"zone {zone_id} is somebody else's: choose another id")
        return None if entry is None else entry.zone

    def _refuse(self, source: _Source, topic: str, reason: str) -> None:
        name = source.site.id
        REFUSALS.labels(name).inc()
        source.refused += 1
        self._limited.warning("zone_request_refused", name, self._zones.now().now, topic=topic, reason=reason)
        self._tell(source, reason[:MAX_PROBLEM])

    def _tell(self, source: _Source, problem: str) -> None:
        """Publish a source's latest problem, or that there is none any more."""
        if problem != source.problem:
            source.problem = problem
            self._publish([Publication(ch.ZONE_SOURCE_PROBLEM, problem or None, {"source": source.site.id})])


def _who(source: str) -> str:
    """Return how the audit trail names a source: as no token is named."""
    return f"source {source}"


def _requested_zone(source: ZoneSourceSite, received: _Received, request: ZoneRequest, at: Moment) -> Zone:
    """Return the zone that a source asks for; raises `RefusedRequestError` for one that it may not have."""
    name = received.subject
    if request.kind not in source.kinds:
        kinds = ", ".join(source.kinds) or "none"
        raise RefusedRequestError(f"zone {name}: this source may put {kinds}, and no {request.kind}")
    if (request.ttl_s is None) == (request.expires_at is None):
        raise RefusedRequestError(f"zone {name}: give either ttl_s or expires_at, and not both: a zone must end")
    if request.ttl_s is not None:
        if received.retained:
            raise RefusedRequestError(f"zone {name}: a retained message may be old: give expires_at instead of ttl_s")
        rest = request.ttl_s
    elif not at.synchronized:
        raise RefusedRequestError(f"zone {name}: the fog node does not know the time of day: give ttl_s")
    else:
        assert request.expires_at is not None
        rest = request.expires_at - at.stamp
        if rest <= 0.0 and not received.retained:
            raise RefusedRequestError(f"zone {name}: expires_at has passed: give a later time")
    if rest > source.max_ttl_s:
        raise RefusedRequestError(f"zone {name}: it may last {source.max_ttl_s:g} s at most: end it sooner")
    return Zone(
        id=name,
        kind=request.kind,
        shape=request.shape,
        factor=request.factor,
        speed=request.speed,
        reason=request.reason,
        author=_who(source.id),
        expires_at=request.expires_at if request.ttl_s is None else at.stamp + request.ttl_s,
        ttl_s=request.ttl_s,
        source=source.id,
    )
