"""The planner: `python -m planner`, configured by FOGNAV_* variables. Safe to kill and restart at any time."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.messages import MapHeartbeat
from fog_kernels.cache import release_bitcode
from fog_runtime import logs, process
from fog_runtime.clock import SystemClock, WallClock, WallClockSource
from fog_runtime.configuration.settings import InflationSettings, SettingsError, describe, load
from fog_runtime.configuration.site import load_site
from fog_runtime.configuration.uploaded_maps import UploadedMaps
from fog_runtime.health import Health
from fog_runtime.http import HttpProcess, load_tokens, unused
from fog_runtime.keys import KeyFileError, read_operator_key
from fog_runtime.leadership import Leadership
from fog_runtime.lease_store import LeaseStore
from fog_runtime.process import release_startup_memory, release_when
from fog_runtime.transports.zenoh_edge import ZenohEdge
from planner.api import make_api
from planner.config import PlannerConfig, WaitMode
from planner.core import PlannerCore
from planner.service import Service
from planner.store import Store

if TYPE_CHECKING:
    from pathlib import Path

MAP_CHANGE: Final = "map-change"
"""Who stops robots, in the audit trail, when another map comes."""

_log = logs.get("planner")


class Settings(InflationSettings, frozen=True, kw_only=True):
    """The inflation should equal the map-service's: a different one only makes the search slower.

    `release_m` is the released length: how far (m) a robot may drive without a message from the planner. `wait`:
    whether robots wait before what closes their way, if that is expected to be quicker than the way round (ADR 72).
    `time_in_cost`: whether a slow place is gone round when that is quicker (ADR 75). `wall_clock`: when the time of day
    is believed, as by the map-service.
    """

    release_m: float = 15.0
    wait: WaitMode = "learned"
    time_in_cost: bool = True
    wall_clock: WallClockSource = "kernel"


def read_key(file: Path | None) -> bytes | None:
    """Return the key that signs commands to robots, None without a file; raises `SettingsError` for an unusable one.

    Without it the planner can stop robots, but not enable them.
    """
    if file is None:
        return None
    try:
        return read_operator_key(file)
    except KeyFileError as error:
        raise SettingsError(str(error)) from error


async def main() -> None:
    """Connect, load the missions, then plan until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("planner", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    release_bitcode()
    release_startup_memory()
    described = load_site(settings.site_dir).site  # without the map, which comes from the map-service
    site = settings.site or described.id
    maps = UploadedMaps(settings.maps_folder / site)
    clock = SystemClock(settings.speed)
    health = Health("store", "goals", "map", "zenoh")
    tokens = load_tokens(settings.tokens_file, settings.session_key_file)
    key = read_key(settings.operator_key_file)
    own = settings.credentials()
    http_process = HttpProcess.fork(
        lambda: make_api(unused(), described, health, tokens),
        settings.http_host, settings.http_port, settings.http_certificate(), settings.http_gateway,
    )  # fmt: skip
    config = PlannerConfig(
        inflation=settings.inflation, release_length=settings.release_m, wait=settings.wait,
        time_in_cost=settings.time_in_cost,
    )  # fmt: skip
    async with (
        Store(settings.redis_url, site, service="planner", data_dir=settings.data_dir, credentials=own) as store,
        LeaseStore(settings.redis_url, site, "planner", credentials=own) as leases,
        ZenohEdge.open(
            connect=settings.zenoh_endpoints, clock=clock, role="planner", id=site, site=site, credentials=own
        ) as zenoh,
    ):
        core = PlannerCore(config=config)
        leadership = Leadership(
            "planner", leases, zenoh, health, connected=lambda: zenoh.connected, epochs=lambda: core.fence.epochs
        )
        # A clock of another speed tells no time of day.
        synchronized = WallClock(settings.wall_clock if settings.speed == 1.0 else "trusted").synchronized
        service = Service(
            core, store, zenoh, clock, health, leadership, key=key, site=described, synchronized=synchronized
        )
        service.subscribe()
        leadership.subscribe()
        zenoh.subscribe(ch.MAP_HEARTBEAT, MapHeartbeat, lambda _, heartbeat: leadership.ask(heartbeat.sent))
        zenoh.declare_liveliness("planner", site)

        async def stop_robots() -> None:
            if leadership.answers():
                await service.operator.stop_all(service.missions, MAP_CHANGE)

        app = make_api(service, described, health, tokens, leadership.standby_reason)
        try:
            async with asyncio.TaskGroup() as tasks:
                needs = {"zenoh": zenoh.router_answers, "planning": service.core_answers, "map": service.has_map}
                tasks.create_task(leadership.run(service, needs, service.core_answers), name="lease")
                tasks.create_task(service.missions.store_loop(), name="store")
                tasks.create_task(service.operator.record_loop(), name="stops")
                tasks.create_task(service.snapshots.snapshot_loop(), name="snapshot")
                tasks.create_task(service.tick_loop(), name="tick")
                tasks.create_task(service.plan_loop(), name="plan")
                tasks.create_task(service.visiting.run(), name="visits")
                tasks.create_task(service.riding.run(), name="rides")
                tasks.create_task(service.scheduling.run(), name="schedules")
                tasks.create_task(maps.until_changed(stop_robots), name="another-map")
                tasks.create_task(http_process.serve(app, settings.port_file), name="http")
                tasks.create_task(release_when(lambda: health.ready), name="memory")
        finally:
            service.close()


if __name__ == "__main__":
    process.run(main)
