"""The hazard aggregator: `python -m hazard_aggregator`, configured by FOGNAV_* variables. Safe to kill at any time."""

from __future__ import annotations

import asyncio
import os
from typing import Final

from fog_contracts import channels as ch
from fog_contracts.cones import node_cones, sonar_cones
from fog_contracts.handlers import Moment
from fog_runtime import logs, process
from fog_runtime.clock import SystemClock, boot_id
from fog_runtime.configuration.settings import CommonSettings, describe, load
from fog_runtime.configuration.uploaded_maps import UploadedMaps
from fog_runtime.health import Health
from fog_runtime.http import HttpProcess, load_tokens, unused
from fog_runtime.leadership import Leadership
from fog_runtime.lease_store import LeaseStore
from fog_runtime.process import process_id, release_startup_memory
from fog_runtime.transports.mqtt_edge import MqttEdgeWithInputs
from fog_runtime.transports.zenoh_edge import ZenohEdge
from hazard_aggregator.api import make_api
from hazard_aggregator.areas import Members
from hazard_aggregator.core import Aggregator
from hazard_aggregator.debounce import DEFAULT_RULE
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.overrides import StoredOverrides
from hazard_aggregator.publisher import LAST_WILL
from hazard_aggregator.records import UnusableAreas
from hazard_aggregator.registry import find_rule
from hazard_aggregator.service import Service
from hazard_aggregator.store import Store, load_at_start

SENSORS: Final = (ch.NODE_READING, ch.NODE_VALUE, ch.NODE_AVAILABILITY, ch.THESIS_AREA)
"""What nodes say comes in one order, and does not delay what the aggregator says (docs/performance.md)."""

_log = logs.get("aggregator")


class Settings(CommonSettings, frozen=True, kw_only=True):
    """`debounce` names the rule of areas that choose none (entry points `fognav.debounce_rules`)."""

    debounce: str = DEFAULT_RULE


async def main() -> None:
    """Connect, load the stored areas and hazards, then turn readings into hazards until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("hazard-aggregator", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    release_startup_memory()
    loaded, maps = UploadedMaps.load(settings.maps_folder, settings.site_dir, settings.site)
    site = settings.site or loaded.site.id
    clock = SystemClock(settings.speed)
    health = Health("store", "mqtt")
    tokens = load_tokens(settings.tokens_file, settings.session_key_file)
    own = settings.credentials()
    http_process = HttpProcess.fork(
        lambda: make_api(unused(), loaded.map, clock, health, tokens),
        settings.http_host, settings.http_port, settings.http_certificate(), settings.http_gateway,
    )  # fmt: skip
    async with (
        Store(
            settings.redis_url, site, service="hazard-aggregator", data_dir=settings.data_dir, credentials=own
        ) as store,
        LeaseStore(settings.redis_url, site, "hazard-aggregator", credentials=own) as leases,
    ):
        stored, loaded_from_store = await load_at_start(store)
        nodes = {node.id: node for node in loaded.site.nodes}
        cones = node_cones(loaded.site.nodes, loaded.map)
        unusable = UnusableAreas(Members(nodes, find_rule, settings.debounce, cones).checked, health)
        usable = unusable.made_usable(stored.definitions, stored.unreadable)
        definitions = {d.id: d for d in [*unusable.of_site(loaded.site.definitions()), *usable]}
        fusion = AreaFusion(
            definitions.values(), loaded.site.nodes, 0, stored.hazards,
            registry=find_rule, default_rule=settings.debounce, cones=cones, robots=loaded.site.robots,
            sonar_cones=sonar_cones(loaded.site.nodes, loaded.map),
        )  # fmt: skip
        mqtt = MqttEdgeWithInputs(
            settings.mqtt_url, process_id("hazard-aggregator"), clock, site=site, inputs=SENSORS, will=LAST_WILL,
            credentials=own,
        )  # fmt: skip
        async with ZenohEdge.open(
            connect=settings.zenoh_endpoints, clock=clock, role="hazard-aggregator", id=site, site=site, credentials=own
        ) as zenoh:
            leadership = Leadership(
                "hazard-aggregator", leases, zenoh, health, connected=lambda: zenoh.connected or mqtt.connected
            )
            core = Aggregator(fusion, complete=loaded_from_store)
            boot = boot_id()
            service = Service(core, store, mqtt, zenoh, clock, health, leadership, boot=boot, site=site)
            if loaded_from_store:
                core.load_overrides(
                    StoredOverrides(stored.overrides, stored.rests, boot), Moment(clock.now(), clock.stamp())
                )
                service.records.mark_loaded()
            service.subscribe()
            await service.records.subscribe()
            leadership.subscribe()
            zenoh.declare_liveliness("hazard-aggregator", site)
            app = make_api(service, loaded.map, clock, health, tokens, leadership.standby_reason)
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(leadership.run(service, {"mqtt": mqtt.broker_answers}), name="lease")
                tasks.create_task(mqtt.run(), name="mqtt")
                tasks.create_task(service.tick_loop(), name="tick")
                tasks.create_task(service.write_loop(), name="write")
                tasks.create_task(service.store_loop(), name="store")
                tasks.create_task(service.history.run(), name="history")
                tasks.create_task(service.alerts.run(), name="alerts")
                tasks.create_task(maps.until_changed(), name="another-map")
                tasks.create_task(http_process.serve(app, settings.port_file), name="http")


if __name__ == "__main__":
    process.run(main)
