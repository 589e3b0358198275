"""The files that the channel table and the settings' types generate, each with its path in the checkout.

The REST routes come from OpenAPI. The services' apps are created without a service behind them: describing the routes
calls no service.
"""

from collections.abc import Callable, Mapping
from importlib.metadata import distribution
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fog_contracts.generate.acl import mqtt_acl, zenoh_acl
from fog_contracts.generate.header import firmware_header
from fog_contracts.generate.markdown import OpenApi, channels_markdown
from fog_contracts.generate.robot_toml import robot_settings_markdown
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.robot_file import default_robot
from fog_runtime.configuration.site import load_site
from fog_runtime.health import Health
from fog_runtime.http import Tokens, unused
from fognav import checkout
from robot_agent import registry

if TYPE_CHECKING:
    import msgspec

WRITE: Final = "./fognav channels --write"
"""The command that updates all generated files."""


def rest_routes() -> dict[str, OpenApi]:
    """Return each service's OpenAPI description by the service's name."""
    # The services import kernels and web frameworks, which takes time: only this function needs them.
    from hazard_aggregator.api import make_api as make_aggregator  # noqa: PLC0415  # see above
    from map_service.api import make_api as make_map  # noqa: PLC0415  # same
    from planner.api import make_api as make_planner  # noqa: PLC0415  # same

    loaded = load_site(checkout.site_folder(None))
    clock, health, tokens = SystemClock(), Health(), Tokens()
    service = unused()
    return {
        "hazard-aggregator": make_aggregator(service, loaded.map.geometry, clock, health, tokens).openapi(),
        "map-service": make_map(service, loaded.site, clock, health, tokens).openapi(),
        "planner": make_planner(service, loaded.site, health, tokens).openapi(),
    }


def markdown() -> str:
    """Return `docs/channels.md`."""
    return channels_markdown(rest_routes())


def robot_settings() -> str:
    """Return `docs/robot-settings.md`."""
    own = distribution("robot-agent").entry_points
    drivers: list[tuple[str, msgspec.Struct]] = []
    for part, group in (("base", registry.BASES), ("lidar", registry.LIDARS)):
        for name in sorted(point.name for point in own if point.group == group):
            robot = default_robot(**{part: name})
            drivers.append((f"`[{part}.options]` of `{name}`", registry.options(robot)[part == "lidar"]))
    return robot_settings_markdown(default_robot().settings, drivers)


FILES: Final[Mapping[str, Callable[[], str]]] = {
    "docs/channels.md": markdown,
    "docs/robot-settings.md": robot_settings,
    "deploy/mosquitto/acl": mqtt_acl,
    "deploy/zenoh/acl.json5": zenoh_acl,
    "firmware/include/fognav_contract.h": firmware_header,
}
"""The generator of each file, by its path in the checkout."""


def acls(folder: Path | None) -> tuple[str, str]:
    """Return the access lists of the MQTT broker and of the zenoh router, for the site in `folder` or for any site.

    Those of a site list its robots by id. Raises `SiteError`.
    """
    if folder is None:
        return mqtt_acl(), zenoh_acl()
    site = load_site(folder).site
    return mqtt_acl(site.id), zenoh_acl(site.id, [robot.id for robot in site.robots])


def stale(folder: Path) -> list[str]:
    """Return the names of the files in a checkout that are out of date or missing."""
    return [name for name, make in FILES.items() if not _is_current(folder / name, make())]


def write(folder: Path) -> list[str]:
    """Write the files in a checkout that are out of date or missing; return their names."""
    written = []
    for name, make in FILES.items():
        text = make()
        if not _is_current(folder / name, text):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text, "utf-8")
            written.append(name)
    return written


def _is_current(file: Path, text: str) -> bool:
    return file.is_file() and file.read_text("utf-8") == text
