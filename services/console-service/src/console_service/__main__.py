"""The console-service: `python -m console_service`, configured by FOGNAV_* variables. Nothing in the fog needs it."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

from console_service.api import make_api
from console_service.core import ConsoleCore
from console_service.forward import AGGREGATOR, MAP_SERVICE, PLANNER, Forward
from console_service.service import Service
from fog_runtime import logs, process
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.settings import CommonSettings, describe, load
from fog_runtime.configuration.site import load_site
from fog_runtime.health import Health
from fog_runtime.http import load_tokens, serve_here
from fog_runtime.leadership import process_id
from fog_runtime.process import release_startup_memory
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge

NICENESS = 5
"""Services that robots wait for go before it."""

_log = logs.get("console-service")


class Settings(CommonSettings, frozen=True, kw_only=True):
    """Where the other services serve REST, and the folder of the built page (empty: that of the package)."""

    aggregator_url: str = "http://127.0.0.1:8001"
    map_url: str = "http://127.0.0.1:8002"
    planner_url: str = "http://127.0.0.1:8003"
    page_dir: Path | None = None


async def main() -> None:
    """Connect, then serve until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("console-service", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    os.nice(NICENESS)
    release_startup_memory()
    site = settings.site or load_site(settings.site_dir).site.id
    clock = SystemClock(settings.speed)
    health = Health("mqtt", "zenoh")
    tokens = load_tokens(settings.tokens_file, settings.session_key_file)
    own = settings.credentials()
    mqtt = MqttEdge(settings.mqtt_url, process_id("console-service"), clock, site=site, credentials=own)
    urls = {AGGREGATOR: settings.aggregator_url, MAP_SERVICE: settings.map_url, PLANNER: settings.planner_url}
    async with (
        Forward(urls, proof=tokens.gateway_proof, trusted=own.tls_context()) as forward,
        ZenohEdge.open(
            connect=settings.zenoh_endpoints, clock=clock, role="console-service", id=site, site=site, credentials=own
        ) as zenoh,
    ):
        service = Service(ConsoleCore(), mqtt, zenoh, clock, health)
        service.subscribe()
        app = make_api(service, health, tokens, forward=forward, page=settings.page_dir)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(mqtt.run(), name="mqtt")
            tasks.create_task(service.tick_loop(), name="tick")
            tasks.create_task(
                serve_here(
                    app,
                    settings.http_host,
                    settings.http_port,
                    settings.http_certificate(),
                    settings.http_gateway,
                    settings.port_file,
                ),
                name="http",
            )


if __name__ == "__main__":
    process.run(main)
