"""The map-service: `python -m map_service`, configured by FOGNAV_* variables. Safe to kill and restart at any time."""

from __future__ import annotations

import asyncio
import os

from msgspec.structs import replace

from fog_contracts import channels as ch
from fog_runtime import logs, metrics, process
from fog_runtime.backup import STAMP
from fog_runtime.certificates import watch_certificates
from fog_runtime.clock import SystemClock, WallClock, WallClockSource, boot_id
from fog_runtime.configuration.settings import InflationSettings, describe, load
from fog_runtime.configuration.uploaded_maps import UploadedMaps
from fog_runtime.health import Health
from fog_runtime.http import HttpProcess, load_tokens, unused
from fog_runtime.leadership import Leadership
from fog_runtime.lease_store import LeaseStore
from fog_runtime.process import process_id, release_startup_memory
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge
from map_service.api import make_api
from map_service.core import MapCore
from map_service.registry import make_layers
from map_service.service import Service
from map_service.store import Store

_log = logs.get("map")


class Settings(InflationSettings, frozen=True, kw_only=True):
    """Settings of the map-service.

    `hazards_wait_s`: how long (s) the first map waits for the aggregator's hazards. `wall_clock`: when the time of day
    is believed: while the kernel says that it is synchronized (`kernel`), or always (`trusted`).
    """

    hazards_wait_s: float = 3.0
    wall_clock: WallClockSource = "kernel"


async def main() -> None:
    """Connect, load the stored zones, then maintain the map until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("map-service", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    release_startup_memory()
    loaded, maps = UploadedMaps.load(settings.maps_folder, settings.site_dir, settings.site)
    site = settings.site or loaded.site.id
    clock = SystemClock(settings.speed)
    health = Health("store", "zones", "mqtt", "map")
    metrics.watch_disk(settings.data_dir)
    metrics.watch_backup(settings.data_dir / STAMP)
    tokens = load_tokens(settings.tokens_file, settings.session_key_file)
    own = settings.credentials()
    http_process = HttpProcess.fork(
        lambda: make_api(unused(), loaded.site, clock, health, tokens),
        settings.http_host, settings.http_port, settings.http_certificate(), settings.http_gateway,
    )  # fmt: skip
    async with (
        Store(settings.redis_url, site, service="map-service", data_dir=settings.data_dir, credentials=own) as store,
        LeaseStore(settings.redis_url, site, "map-service", credentials=own) as leases,
    ):
        core = MapCore(
            site,
            loaded.map,
            inflation=settings.inflation,
            layers=make_layers(loaded.map, loaded.site.layers),
            definitions=loaded.site.definitions(),
            hazards_wait_s=settings.hazards_wait_s,
        )
        mqtt = MqttEdge(settings.mqtt_url, process_id("map-service"), clock, site=site, credentials=own)
        async with ZenohEdge.open(
            connect=settings.zenoh_endpoints, clock=clock, role="map-service", id=site, site=site, credentials=own
        ) as zenoh:
            leadership = Leadership(
                "map-service", leases, zenoh, health,
                connected=lambda: zenoh.connected, epochs=lambda: {ch.AGGREGATOR: core.aggregator.epoch or 0},
            )  # fmt: skip
            # A clock of another speed tells no time of day.
            synchronized = WallClock(settings.wall_clock if settings.speed == 1.0 else "trusted").synchronized
            service = Service(
                core, store, mqtt, zenoh, clock, health, leadership,
                site=replace(loaded.site, id=site), maps=maps, synchronized=synchronized, boot=boot_id(),
            )  # fmt: skip
            service.subscribe()
            leadership.subscribe()
            zenoh.declare_liveliness("map-service", site)
            app = make_api(
                service, loaded.site, clock, health, tokens, leadership.standby_reason, site_dir=settings.site_dir
            )
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(mqtt.run(), name="mqtt")
                needs = {"mqtt": mqtt.broker_answers, "zenoh": zenoh.router_answers, "map": service.serves}
                tasks.create_task(leadership.run(service, needs), name="lease")
                tasks.create_task(service.store_loop(), name="store")
                tasks.create_task(service.tick_loop(), name="tick")
                tasks.create_task(service.zone_sources.run(), name="zone-sources")
                tasks.create_task(service.publisher.commit_loop(), name="commit")
                tasks.create_task(maps.until_changed(), name="another-map")
                tasks.create_task(watch_certificates(settings, own), name="certificates")
                tasks.create_task(http_process.serve(app, settings.port_file), name="http")


if __name__ == "__main__":
    process.run(main)
