"""The console-service: `python -m console_service`, configured by FOGNAV_* variables. Nothing in the fog needs it."""

from __future__ import annotations

import asyncio
import os
import secrets
from pathlib import Path
from typing import get_args

import msgspec

from console_service.api import make_api
from console_service.core import ConsoleCore, Fetched
from console_service.floors import Hub, read_peers
from console_service.forward import AGGREGATOR, DEMO, MAP_SERVICE, PLANNER, Forward
from console_service.service import Service
from console_service.sources import Sources
from fog_runtime import logs, process
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.settings import CommonSettings, describe, load
from fog_runtime.configuration.site import load_site
from fog_runtime.health import Health
from fog_runtime.http import load_tokens, serve_here
from fog_runtime.process import process_id, release_startup_memory
from fog_runtime.stores.redis_connection import RedisConnection
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge

NICENESS = 5
"""Services that robots wait for go before it."""

_log = logs.get("console-service")


class Settings(CommonSettings, frozen=True, kw_only=True):
    """Where the other services serve REST, and the folder of the built page (empty: that of the package).

    `demo_url`: where a demo tells about its scenario. `bridge_url`: where the bridge serves WebSockets, if one runs.
    `floors_file`: the list of floors on other machines.
    """

    aggregator_url: str = "http://127.0.0.1:8001"
    map_url: str = "http://127.0.0.1:8002"
    planner_url: str = "http://127.0.0.1:8003"
    page_dir: Path | None = None
    demo_url: str = ""
    bridge_url: str = ""
    floors_file: Path | None = None


async def main() -> None:
    """Connect, then serve until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("console-service", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    os.nice(NICENESS)
    release_startup_memory()
    described = load_site(settings.site_dir).site
    site = settings.site or described.id
    clock = SystemClock(settings.speed)
    health = Health("mqtt", "zenoh")
    tokens = load_tokens(settings.tokens_file, settings.session_key_file)
    own = settings.credentials()
    mqtt = MqttEdge(settings.mqtt_url, process_id("console-service"), clock, site=site, credentials=own)
    hub = Hub(read_peers(settings.floors_file, site), clock)
    urls = {AGGREGATOR: settings.aggregator_url, MAP_SERVICE: settings.map_url, PLANNER: settings.planner_url}
    if settings.demo_url:
        urls[DEMO] = settings.demo_url
    async with (
        Forward(urls, bridge=settings.bridge_url, proof=tokens.gateway_proof, trusted=own.tls_context()) as forward,
        ZenohEdge.open(
            connect=settings.zenoh_endpoints, clock=clock, role="console-service", id=site, site=site, credentials=own
        ) as zenoh,
    ):
        core = ConsoleCore(
            site,
            secrets.token_hex(4),
            robots=described.robots,
            nodes={node.id: msgspec.to_builtins(node) for node in described.nodes},
        )
        core.on_places(described.places, clock.now())
        redis = RedisConnection(settings.redis_url, credentials=own)
        service = Service(core, mqtt, zenoh, redis, clock, health)
        service.subscribe()
        sources = Sources(
            core, clock, aggregator_url=settings.aggregator_url, redis=redis, credentials=own,
            on_news=service.readers.wake,
        )  # fmt: skip
        app = make_api(service, health, tokens, forward=forward, hub=hub, page=settings.page_dir)
        serving = serve_here(
            app, settings.http_host, settings.http_port, settings.http_certificate(), settings.http_gateway,
            settings.port_file,
        )  # fmt: skip
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(mqtt.run(), name="mqtt")
                tasks.create_task(service.tick_loop(), name="tick")
                tasks.create_task(service.map_loop(), name="map")
                tasks.create_task(service.tile_loop(), name="tiles")
                for event in get_args(Fetched):
                    tasks.create_task(sources.fetch_loop(event), name=f"{event}s")
                tasks.create_task(sources.record_loop(), name="records")
                tasks.create_task(service.recording_loop(), name="recording")
                tasks.create_task(service.readers.run(), name="readers")
                tasks.create_task(service.readers.tell_time(clock.stamp), name="time")
                tasks.create_task(hub.run(), name="floors")
                tasks.create_task(serving, name="http")
        finally:
            service.close()
            await sources.aclose()
            await redis.aclose()


if __name__ == "__main__":
    process.run(main)
