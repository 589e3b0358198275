"""The files that the channel table generates, each with its place in the checkout; the REST routes are the services'.

The services' apps are built over no service at all: describing their routes calls none of them.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Self

from fog_contracts.generate.header import firmware_header
from fog_contracts.generate.markdown import OpenApi, channels_markdown
from fog_contracts.generate.mqtt_acl import mqtt_acl
from fog_contracts.generate.zenoh_acl import zenoh_acl
from fog_runtime.clock import SystemClock
from fog_runtime.health import Health
from fog_runtime.http import Tokens
from fog_runtime.site import load_site
from fognav import checkout

WRITE: Final = "./fognav channels --write"
"""What brings all generated files up to date."""


def rest_routes() -> dict[str, OpenApi]:
    """Return each service's OpenAPI description by the service's name."""
    # The services bring kernels and web frameworks with them: only who asks for the routes waits for these.
    from hazard_aggregator.api import make_api as make_aggregator  # noqa: PLC0415  # see above
    from map_service.api import make_api as make_map  # noqa: PLC0415  # same
    from planner.api import make_api as make_planner  # noqa: PLC0415  # same

    loaded = load_site(checkout.site_folder(None))
    clock, health, tokens = SystemClock(), Health(), Tokens()
    nothing: Any = _NoService()
    return {
        "hazard-aggregator": make_aggregator(nothing, loaded.map.geometry, clock, health, tokens).openapi(),
        "map-service": make_map(nothing, loaded.site, clock, health, tokens).openapi(),
        "planner": make_planner(nothing, loaded.site, health, tokens).openapi(),
    }


class _NoService:
    """Stands where a service would: an app may look into it when it is built, but nothing is ever called."""

    def __getattr__(self, name: str) -> Self:
        return self


def markdown() -> str:
    """Return `docs/channels.md`."""
    return channels_markdown(rest_routes())


FILES: Final[Mapping[str, Callable[[], str]]] = {
    "docs/channels.md": markdown,
    "deploy/mosquitto/acl": mqtt_acl,
    "deploy/zenoh/acl.json5": zenoh_acl,
    "firmware/include/fognav_contract.h": firmware_header,
}
"""What generates each file, by its path in the checkout."""


def acls(folder: Path | None) -> tuple[str, str]:
    """Return the lists of the MQTT broker and of the zenoh router: for the site in `folder` only, or for any.

    Those of a site know its robots by their ids. Raises `SiteError`.
    """
    if folder is None:
        return mqtt_acl(), zenoh_acl()
    site = load_site(folder).site
    return mqtt_acl(site.id), zenoh_acl(site.id, [robot.id for robot in site.robots])


def stale(folder: Path) -> list[str]:
    """Return which of the files in a checkout are not what would be generated now, or are missing."""
    return [name for name, make in FILES.items() if not _is(folder / name, make())]


def write(folder: Path) -> list[str]:
    """Write the files that are stale in a checkout; return their names."""
    written = []
    for name, make in FILES.items():
        text = make()
        if not _is(folder / name, text):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text, "utf-8")
            written.append(name)
    return written


def _is(file: Path, text: str) -> bool:
    return file.is_file() and file.read_text("utf-8") == text
