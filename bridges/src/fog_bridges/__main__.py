"""The bridges: `python -m fog_bridges`, configured by FOGNAV_* variables. A floor runs without it."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

from fog_bridges.floor import Floor
from fog_bridges.home_assistant import HomeAssistant
from fog_bridges.service import HomeAssistantBridge
from fog_contracts import channels as ch
from fog_runtime import logs, process
from fog_runtime.clock import SystemClock, ticker
from fog_runtime.configuration.settings import CommonSettings, SettingsError, describe, load
from fog_runtime.configuration.site import load_site
from fog_runtime.credentials import Credentials
from fog_runtime.health import Health
from fog_runtime.http import make_app, serve_here
from fog_runtime.http.tokens import Tokens
from fog_runtime.leadership import process_id
from fog_runtime.transports.mqtt_edge import MqttEdge, Will

_log = logs.get("bridge")


class Settings(CommonSettings, frozen=True, kw_only=True):
    """The console's address, and the file of a token for it, as `fognav token create --out` writes it."""

    console_url: str
    token_file: Path


async def main() -> None:
    """Connect, then serve until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("bridge", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    site = settings.site or load_site(settings.site_dir).site.id
    own, caller = settings.credentials(), Credentials.read(settings.token_file)
    if not caller.token:
        raise SettingsError(
            f"{settings.token_file} has no token. Make one: fognav token create home-assistant --role operator "
            "--file TOKENS --credentials DIR --out FILE"
        )
    clock, health = SystemClock(settings.speed), Health("floor", "mqtt")
    will = Will(ch.BRIDGE_AVAILABILITY, ch.OFFLINE)
    mqtt = MqttEdge(settings.mqtt_url, process_id("bridge"), clock, site=site, will=will, credentials=own)
    encrypted = settings.console_url.startswith("https:")
    floor = Floor(settings.console_url, caller.token, caller.tls_context() if encrypted else True)
    bridge = HomeAssistantBridge(HomeAssistant(site), floor, mqtt)

    async def health_loop() -> None:
        async for _ in ticker(clock, 0.2):
            health.set("mqtt", ok=mqtt.connected, detail="" if mqtt.connected else "not connected")
            health.set("floor", ok=not floor.problem, detail=floor.problem)

    app = make_app("Fognav bridges", health, Tokens())
    serving = serve_here(
        app, settings.http_host, settings.http_port, settings.http_certificate(), settings.http_gateway,
        settings.port_file,
    )  # fmt: skip
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(mqtt.run(), name="mqtt")
            tasks.create_task(floor.follow(bridge.on_event, bridge.on_lost), name="floor")
            tasks.create_task(bridge.order_loop(), name="orders")
            tasks.create_task(bridge.picture_loop(clock), name="picture")
            tasks.create_task(health_loop(), name="health")
            tasks.create_task(serving, name="http")
    finally:
        await floor.aclose()


if __name__ == "__main__":
    process.run(main)
