"""A floor's costmap, followed by its own channels: faster than the console tells of it."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.follower import MapFollower
from fog_contracts.messages import MapDelta, MapHeartbeat, MapSnapshot
from fog_contracts.replica import MapError, decode_map
from fog_runtime import logs
from fog_runtime.clock import ticker

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from fog_contracts.replica import Replica
    from fog_runtime.clock import Clock
    from fog_runtime.transports.zenoh_edge import ZenohEdge

TICK_S: Final = 0.1
SNAPSHOT_TIMEOUT_S: Final = 3.0
_log = logs.get("map")


class FollowedMap:
    """A copy of the costmap that stays up to date while `run` runs."""

    def __init__(self, fog: ZenohEdge, clock: Clock, on_change: Callable[[], object]) -> None:
        """Call `on_change` whenever the copy has changed."""
        self._fog = fog
        self._clock = clock
        self._on_change = on_change
        self._follower = MapFollower()

    @property
    def replica(self) -> Replica:
        """The copy."""
        return self._follower.replica

    @property
    def age_s(self) -> float:
        """How long ago the map was confirmed last (s)."""
        return self._follower.age(self._clock.now())

    async def run(self) -> None:
        """Subscribe, and fetch the map whenever its deltas alone do not lead to the newest one. Never returns."""
        self._fog.subscribe(ch.MAP_DELTA, MapDelta, self._on_delta)
        self._fog.subscribe(ch.MAP_HEARTBEAT, MapHeartbeat, self._on_heartbeat)
        async for now in ticker(self._clock, TICK_S):
            if self._follower.wants_snapshot(now):
                await self._load()

    async def _load(self) -> None:
        try:
            snapshot = await self._fog.query(ch.MAP_SNAPSHOT, None, MapSnapshot, SNAPSHOT_TIMEOUT_S)
            if snapshot is None:
                return  # the map-service does not answer: readiness says so
            loaded = await asyncio.to_thread(partial(decode_map, snapshot))
            self._follower.on_snapshot(loaded, self._clock.now())
        except (MapError, ContractError) as error:
            _log.warning("map_refused", reason=str(error))
            return
        self._on_change()

    def _on_delta(self, _: Mapping[str, str], delta: MapDelta) -> None:
        if self._follower.on_delta(delta, self._clock.now()) is not None:
            self._on_change()

    def _on_heartbeat(self, _: Mapping[str, str], heartbeat: MapHeartbeat) -> None:
        self._follower.on_heartbeat(heartbeat, self._clock.now())
