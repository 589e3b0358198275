"""Home Assistant's own MQTT integration as a program, run by a Python that has `homeassistant` (and `paho-mqtt`).

    PYTHON home_assistant.py FOLDER '{"broker": "127.0.0.1", "port": 1883, ...}'

Standard input has a line for each question, standard output a line of JSON for each answer:
`states`: {entity: [state, attributes]}; `call DOMAIN SERVICE {DATA}`: null; the warnings of all of it: `log`.
"""

import asyncio
import json
import logging
import socket
import sys
from pathlib import Path

from homeassistant import bootstrap, config_entries, core, loader
from homeassistant.auth import auth_manager_from_config
from homeassistant.setup import async_setup_component


class Warnings(logging.Handler):
    """Keeps what the integration finds wrong."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.name.startswith("homeassistant.components."):
            self.lines.append(self.format(record))


async def start(folder: str, broker: dict[str, object]) -> core.HomeAssistant:
    """Start as much of Home Assistant as the integration needs."""
    (Path(folder) / "configuration.yaml").touch()
    hass = core.HomeAssistant(folder)
    hass.config.skip_pip = True
    hass.config_entries = config_entries.ConfigEntries(hass, {})
    loader.async_setup(hass)
    await bootstrap.async_load_base_functionality(hass)
    hass.auth = await auth_manager_from_config(hass, [], [])
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    # Of its web server, without which the integration does not start.
    assert await async_setup_component(hass, "http", {"http": {"server_host": "127.0.0.1", "server_port": port}})
    entry = config_entries.ConfigEntry(
        domain="mqtt", data={"discovery": True, **broker}, options={}, title="mqtt", version=1, minor_version=2,
        source="user", unique_id=None, discovery_keys={}, subentries_data=None,
    )  # fmt: skip
    await hass.config_entries.async_add(entry)
    assert entry.state is config_entries.ConfigEntryState.LOADED, entry.state
    hass.set_state(core.CoreState.running)
    return hass


async def main(folder: str, broker: str) -> None:
    warnings = Warnings()
    logging.getLogger().addHandler(warnings)
    hass = await start(folder, json.loads(broker))
    while line := await asyncio.to_thread(sys.stdin.readline):
        word, _, rest = line.strip().partition(" ")
        answer: object = None
        if word == "states":
            answer = {each.entity_id: [each.state, dict(each.attributes)] for each in hass.states.async_all()}
        elif word == "log":
            answer = warnings.lines
        else:
            domain, service, data = rest.split(" ", 2)
            await hass.services.async_call(domain, service, json.loads(data), blocking=True)
        sys.stdout.write(json.dumps(answer, default=str) + "\n")
        sys.stdout.flush()
    await hass.async_stop(force=True)


asyncio.run(main(*sys.argv[1:]))
