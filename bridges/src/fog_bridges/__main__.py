"""The bridges: `python -m fog_bridges`, configured by FOGNAV_* variables and a file. A floor runs without them.

`--check` only says whether the settings can be used.
"""

from __future__ import annotations

import asyncio
import os
import re
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal
from urllib.parse import urlsplit

import msgspec

from fog_bridges.floor import Floor, ServesSockets
from fog_bridges.home_assistant import HomeAssistant
from fog_bridges.service import HomeAssistantBridge
from fog_bridges.vda5050.bridge import Vda5050Bridge
from fog_bridges.vda5050.connection import SYSTEM, Setup
from fog_bridges.vda5050.incoming import Version
from fog_contracts import channels as ch
from fog_runtime import logs, process
from fog_runtime.clock import SystemClock, ticker
from fog_runtime.configuration.settings import CommonSettings, SettingsError, describe, load
from fog_runtime.configuration.site import SiteError, load_site
from fog_runtime.credentials import Credentials, CredentialsError
from fog_runtime.health import Health
from fog_runtime.http import make_app, serve_here
from fog_runtime.http.tokens import Tokens
from fog_runtime.process import process_id
from fog_runtime.transports.mqtt_connection import Broker
from fog_runtime.transports.mqtt_edge import MqttEdge, Will

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from fog_bridges.floor import Adapter
    from fog_bridges.ros2.dds import DdsWire
    from fog_bridges.ros2.session import ZenohWire
    from fog_runtime.clock import Clock

FILE: Final = "FOGNAV_BRIDGE_FILE"
"""Names the file of settings; paths in it are relative to its folder."""
_log = logs.get("bridge")


_INSTALL: Final = "pip install --require-hashes -r requirements/fog-bridges.txt (in the checkout and in each release)"
"""What an adapter's packages are installed by."""


Level = Annotated[str, msgspec.Meta(pattern=r"^[^/+#$]{1,64}$(?!\n)")]
"""A level of a topic of MQTT."""


class Settings(CommonSettings, frozen=True, kw_only=True):
    """What to connect with what; `site_dir` is needed without `site` only, and `data_dir` never."""

    site_dir: Path = Path()
    data_dir: Path = Path()
    adapters: str
    """Which systems are told of robots: names of `ADAPTERS`, comma separated."""
    console_url: str
    token_file: Path | None = None
    """A file with an operator's token for the console; None: the token in `credentials_file`."""
    home_assistant_mqtt_url: str = ""
    """Home Assistant's broker; empty: Fognav's own, with the bridge's user there."""
    home_assistant_credentials_file: Path | None = None
    """User, password and authority of Home Assistant's broker, as `credentials_file` has those of Fognav's."""
    home_assistant_unencrypted: bool = False
    """Whether that password may cross the network readable for everybody in it."""
    ros2_wire: Literal["zenoh", "dds"] = "zenoh"
    """How the robots' middleware speaks: `zenoh` for rmw_zenoh, `dds` for rmw_fastrtps and rmw_cyclonedds."""
    ros2_router: str = ""
    """Where rmw_zenoh's router (`rmw_zenohd`) listens; on a fog node its usual port is Fognav's own router's."""
    ros2_domain: Annotated[int, msgspec.Meta(ge=0, le=232)] = 0
    """ROS_DOMAIN_ID of the robots."""
    ros2_robots: str = ""
    """Robots of others that become obstacles: their namespaces and radii (m), `tb4:0.2, carter:0.35`."""
    ros2_session_config: Path | None = None
    """A file as ZENOH_SESSION_CONFIG_URI names one, with TLS, say; then `ros2_router` is not used."""
    vda5050_mqtt_url: str = ""
    """The fleet control's broker; `_credentials_file` and `_unencrypted` as for Home Assistant's."""
    vda5050_credentials_file: Path | None = None
    vda5050_unencrypted: bool = False
    vda5050_version: Version = "3.0"
    vda5050_interface: Level = "vda5050"
    """The first level of its topics."""
    vda5050_manufacturer: Level = "fognav"
    vda5050_map: str = ""
    """The floor's `mapId`; empty: the site's id."""
    vda5050_robots: str = ""
    """Fognav's robots that are under the fleet's control: their ids, comma separated."""
    vda5050_zones: str = ""
    """Robots of others that are told of hazards and zones: MANUFACTURER/SERIAL, comma separated."""

    rmf_level: str = ""
    """The floor's level in Open-RMF; with it, the adapter ros2 tells of hazards and no-go zones as obstacles."""
    rmf_nav_graph: Path | None = None
    """A navigation graph of Open-RMF: its lanes are closed and slowed; needs `rmf_level`."""
    rmf_fleets: str = ""
    """The fleets that drive on these lanes, comma separated."""
    free_fleet_router: str = ""
    """The zenoh router that Open-RMF's free_fleet adapter connects to."""
    free_fleet_session_config: Path | None = None
    """A zenoh configuration file, with TLS, say; then `free_fleet_router` is not used."""

    @property
    def names(self) -> list[str]:
        """The adapters; raises `SettingsError` for one that is unknown, and without any."""
        names = _listed(self.adapters)
        if unknown := [name for name in names if name not in ADAPTERS] or ([] if names else [""]):
            raise SettingsError(f"adapters: {unknown[0]!r} is none. Name one or several of: {', '.join(ADAPTERS)}")
        return names

    def token(self) -> str:
        """Read the token for the console; raises `SettingsError`, `CredentialsError`."""
        try:
            text = self.credentials().token if self.token_file is None else self.token_file.read_text("ascii").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise SettingsError(f"the token file {self.token_file} can't be read: {error}. {_MAKE_TOKEN}") from error
        if not text:
            where = self.token_file or self.credentials_file or "no credentials (FOGNAV_CREDENTIALS_FILE is not set)"
            raise SettingsError(f"there is no token in {where}. {_MAKE_TOKEN}")
        return text


_FILES: Final = (
    "credentials_file", "token_file", "home_assistant_credentials_file", "ros2_session_config",
    "vda5050_credentials_file", "free_fleet_session_config", "rmf_nav_graph",
)  # fmt: skip
_MAKE_TOKEN: Final = "Make one: fognav token create bridge --role operator --file TOKENS > FILE"  # noqa: S105  # no token


def _listed(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _foreign(prefix: str, url: str, file: Path | None, *, unencrypted: bool) -> Credentials:
    """Return who Fognav is at a broker of others; the settings' names begin with `prefix`. Raises `SettingsError`."""
    if urlsplit(url.partition(",")[0]).username:
        raise SettingsError(
            f"{prefix}_mqtt_url has a user: name user and password in {prefix}_credentials_file, which no log shows"
        )
    return Credentials.read(file, readable=unencrypted)


@contextmanager
def _address(prefix: str) -> Iterator[None]:
    """Raise `SettingsError` for a broker's address that can't be used."""
    try:
        yield
    except CredentialsError as error:
        raise SettingsError(f"{error}. Or say that it may: {prefix}_unencrypted = true") from error
    except ValueError as error:
        raise SettingsError(f"{prefix}_mqtt_url: {error}") from error


def _home_assistant(settings: Settings, site: str, clock: Clock) -> Adapter:
    prefix, url = "home_assistant", settings.home_assistant_mqtt_url
    if not url:
        url, own = settings.mqtt_url, settings.credentials()
    else:
        file, readable = settings.home_assistant_credentials_file, settings.home_assistant_unencrypted
        own = _foreign(prefix, url, file, unencrypted=readable)
    will = Will(ch.BRIDGE_AVAILABILITY, ch.OFFLINE)
    with _address(prefix):
        mqtt = MqttEdge(url, process_id("bridge"), clock, site=site, will=will, credentials=own)
    return HomeAssistantBridge(HomeAssistant(site), mqtt, clock)


def _vda5050(settings: Settings, site: str, _: Clock) -> Adapter:
    prefix, url = SYSTEM, settings.vda5050_mqtt_url
    if not url:
        raise SettingsError("vda5050_mqtt_url names the fleet control's broker: mqtts://fleet.local:8883, say")
    own = _foreign(prefix, url, settings.vda5050_credentials_file, unencrypted=settings.vda5050_unencrypted)
    robots, zones = _listed(settings.vda5050_robots), _listed(settings.vda5050_zones)
    if not robots and not zones:
        raise SettingsError(
            'vda5050_robots, or vda5050_zones, names who takes part: "r1, r2", or "MANUFACTURER/SERIAL"'
        )
    if wrong := next((each for each in robots if not re.fullmatch(r"[a-z0-9][a-z0-9-]{0,31}", each)), None):
        raise SettingsError(f"vda5050_robots: {wrong[:80]!r} is no robot's id: `fognav robot status` shows them")
    if wrong := next((each for each in zones if not re.fullmatch(r"[^/+#$]{1,64}/[A-Za-z0-9_.:-]{1,64}", each)), None):
        raise SettingsError(f"vda5050_zones: {wrong[:80]!r} is not MANUFACTURER/SERIAL, as in the robot's topics")
    with _address(prefix):
        broker = Broker.of(url, own)
    setup = Setup(
        site=site, broker=broker, version=settings.vda5050_version, interface=settings.vda5050_interface,
        manufacturer=settings.vda5050_manufacturer, map_id=settings.vda5050_map or site, robots=robots,
        zones=[(each.partition("/")[0], each.partition("/")[2]) for each in zones],
    )  # fmt: skip
    return Vda5050Bridge(setup)


def _ros2(settings: Settings, site: str, _: Clock) -> Adapter:
    try:
        from fog_bridges.ros2.bridge import Ros2Bridge  # noqa: PLC0415  # an extra
        from fog_bridges.ros2.others import robot_radii  # noqa: PLC0415  # an extra
        from fog_bridges.ros2.rmf import Traffic, read_graph  # noqa: PLC0415  # an extra
    except ImportError as error:
        raise SettingsError(f"the adapter ros2 needs more ({error}): {_INSTALL}") from error
    try:
        wire = _dds(settings) if settings.ros2_wire == "dds" else _zenoh(settings)
        others = robot_radii(settings.ros2_robots)
        graph, level = settings.rmf_nav_graph, settings.rmf_level
        fleets = [name for name in map(str.strip, settings.rmf_fleets.split(",")) if name]
        lanes = read_graph(graph, level) if graph is not None else []
    except ValueError as error:
        raise SettingsError(str(error)) from error
    return Ros2Bridge(
        site,
        wire,
        settings.zenoh_endpoints,
        settings.credentials(),
        others,
        Traffic(lanes, fleets, level) if graph is not None or level else None,
    )


def _zenoh(settings: Settings) -> ZenohWire:
    from fog_bridges.ros2.session import ZenohWire, ros_config  # noqa: PLC0415  # an extra

    if settings.ros2_session_config is None and not settings.ros2_router:
        raise SettingsError("ros2_router names where `rmw_zenohd` listens: tcp/192.168.7.5:7447, say")
    return ZenohWire(ros_config(settings.ros2_session_config or settings.ros2_router), settings.ros2_domain)


def _dds(settings: Settings) -> DdsWire:
    try:
        from fog_bridges.ros2.dds import DdsWire  # noqa: PLC0415  # an extra
    except ImportError as error:
        raise SettingsError(f"ros2_wire = 'dds' needs more ({error}): on x86-64, {_INSTALL}") from error
    return DdsWire(settings.ros2_domain)


def _free_fleet(settings: Settings, site: str, _: Clock) -> Adapter:
    try:
        from fog_bridges.free_fleet import FreeFleetBridge  # noqa: PLC0415  # an extra
        from fog_bridges.ros2.session import ros_config  # noqa: PLC0415  # an extra
    except ImportError as error:
        raise SettingsError(f"the adapter free-fleet needs more ({error}): {_INSTALL}") from error
    if settings.free_fleet_session_config is None and not settings.free_fleet_router:
        raise SettingsError(
            "free_fleet_router names the zenoh router of free_fleet's adapter: tcp/192.168.7.6:7447, say"
        )
    try:
        config = ros_config(settings.free_fleet_session_config or settings.free_fleet_router)
    except ValueError as error:
        raise SettingsError(str(error)) from error
    return FreeFleetBridge(site, config, settings.zenoh_endpoints, settings.credentials())


def _foxglove(settings: Settings, site: str, _: Clock) -> Adapter:
    try:
        from fog_bridges.foxglove.bridge import FoxgloveBridge  # noqa: PLC0415  # an extra
    except ImportError as error:
        raise SettingsError(f"the adapter foxglove needs more ({error}): {_INSTALL}") from error
    return FoxgloveBridge(site, settings.zenoh_endpoints, settings.credentials())


ADAPTERS: Final[Mapping[str, Callable[[Settings, str, Clock], Adapter]]] = {
    "home-assistant": _home_assistant,
    "ros2": _ros2,
    "vda5050": _vda5050,
    "foxglove": _foxglove,
    "free-fleet": _free_fleet,
}


def read_settings() -> Settings:
    """Read the settings from the environment and its file; raises `SettingsError`."""
    named = os.environ.get(FILE)
    settings = load(Settings, file=Path(named) if named else None, environ=os.environ)
    files = {name: getattr(settings, name) for name in _FILES}
    folder = Path(named).parent if named else Path()
    return msgspec.structs.replace(settings, **{name: folder / file for name, file in files.items() if file})


async def main() -> None:
    """Connect, then serve until cancelled."""
    settings = read_settings()
    logs.configure("bridge", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    site = settings.site or load_site(settings.site_dir).site.id
    clock = SystemClock(settings.speed)
    adapters = [ADAPTERS[name](settings, site, clock) for name in settings.names]
    health = Health("floor", *(each.name for each in adapters))
    trusted = settings.credentials().tls_context() if settings.console_url.startswith("https:") else True
    floor = Floor(settings.console_url, settings.token(), trusted)

    async def health_loop() -> None:
        async for _ in ticker(clock, 0.2):
            health.set("floor", ok=not floor.problem, detail=floor.problem)
            for each in adapters:
                health.set(each.name, ok=not each.problem, detail=each.problem)

    app = make_app("Fognav bridges", health, Tokens())
    for each in adapters:
        if isinstance(each, ServesSockets):
            app.router.routes.extend(each.routes)
            app.state.sockets = True
    serving = serve_here(
        app, settings.http_host, settings.http_port, settings.http_certificate(), settings.http_gateway,
        settings.port_file,
    )  # fmt: skip
    try:
        async with asyncio.TaskGroup() as tasks:
            for each in adapters:
                tasks.create_task(each.run(floor.of(each.name), clock), name=each.name)
            tasks.create_task(floor.follow(adapters), name="floor")
            tasks.create_task(health_loop(), name="health")
            tasks.create_task(serving, name="http")
            tasks.create_task(process.release_when(lambda: all(not each.problem for each in adapters)), name="memory")
    finally:
        await floor.aclose()


async def _check() -> None:
    """Raise as `main` would for settings that can't be used."""
    settings = read_settings()
    for name in settings.names:
        ADAPTERS[name](settings, settings.site or "check", SystemClock())


if __name__ == "__main__":
    if sys.argv[1:] == ["--check"]:
        try:
            asyncio.run(_check())
        except (SettingsError, CredentialsError, SiteError) as problem:
            sys.exit(str(problem))
    else:
        process.run(main)
