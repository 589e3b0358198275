"""Typed settings of a process: the environment overrides a TOML file, which overrides defaults."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import msgspec

from fog_contracts.costs import DEFAULT_INFLATION, Inflation
from fog_runtime.credentials import Credentials, ServerCertificate
from fog_runtime.logs import Level

S = TypeVar("S", bound=msgspec.Struct)

_PASSWORD: Final = re.compile(r"(?<=://)([^/@:]*):([^/@]*)@")


class SettingsError(ValueError):
    """A setting is missing or invalid; the message names the variable or the file and field, and the remedy.

    `setting` is its dotted name in a robot's file, empty for others.
    """

    def __init__(self, message: str, setting: str = "") -> None:
        super().__init__(message)
        self.setting = setting


class Secret:
    """A value that must not be logged: it prints as `***`, `reveal()` returns it."""

    __slots__ = ("_value",)

    def __init__(self, value: str) -> None:
        self._value = value

    def reveal(self) -> str:
        """Return the value itself."""
        return self._value

    def __str__(self) -> str:
        return "***"

    def __repr__(self) -> str:
        return "Secret(***)"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Secret) and other._value == self._value

    def __hash__(self) -> int:
        return hash(self._value)


class CommonSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of every process of the fog and the robot; a process adds its own by subclassing."""

    site_dir: Path
    data_dir: Path
    site: str = ""
    """Id of the site; empty: that of `site.toml`."""
    maps_dir: Path | None = None
    """Folder of the maps that the fog was given by REST, the same for all services of a site; None: in `data_dir`."""
    speed: float = 1.0
    """How many times faster than real time the clock runs (simulation only)."""
    mqtt_url: str = "mqtt://127.0.0.1:1883"
    """Addresses of the broker, or of several that are bridged, comma separated."""
    redis_url: str = "redis://127.0.0.1:6379/0"
    """As `fog_runtime.stores.redis_connection` describes, also for Sentinels."""
    zenoh_connect: str = "tcp/127.0.0.1:7447"
    """Endpoints of routers, comma separated."""
    http_host: str = "127.0.0.1"
    http_port: int = 0
    """0: any free port; the chosen one is logged (`listening`) and written to `port_file`."""
    http_certificate_file: Path | None = None
    http_key_file: Path | None = None
    """Certificate and private key (PEM) with which the REST API is served by HTTPS; without them by HTTP."""
    http_gateway: str = ""
    """Name or address of a gateway, which is believed for whom it asks (`X-Forwarded-For`); empty: nobody is."""
    port_file: Path | None = None
    log_level: Level = "info"
    log_format: Literal["json", "text"] = "json"
    tokens_file: Path | None = None
    credentials_file: Path | None = None
    """Who this process is, and whom it trusts (`fog_runtime.credentials`); without one it is nobody."""
    operator_key_file: Path | None = None
    session_key_file: Path | None = None
    """The key that signs sessions of the console; without it only tokens are accepted."""

    @property
    def zenoh_endpoints(self) -> list[str]:
        """The endpoints in `zenoh_connect`."""
        return [part.strip() for part in self.zenoh_connect.split(",") if part.strip()]

    @property
    def maps_folder(self) -> Path:
        """The folder of the maps that the fog was given."""
        return self.data_dir / "maps" if self.maps_dir is None else self.maps_dir

    def credentials(self) -> Credentials:
        """Read the process's credentials; raises `CredentialsError`."""
        return Credentials.read(self.credentials_file)

    def http_certificate(self) -> ServerCertificate | None:
        """Read the certificate of the REST API; None without one. Raises `CertificateError`."""
        return ServerCertificate.of(self.http_certificate_file, self.http_key_file)


class InflationSettings(CommonSettings, frozen=True, kw_only=True):
    """Settings of a process that inflates costmaps: radii in m, `cost_scaling` in 1/m."""

    inscribed_radius: float = DEFAULT_INFLATION.inscribed_radius
    inflation_radius: float = DEFAULT_INFLATION.inflation_radius
    cost_scaling: float = DEFAULT_INFLATION.cost_scaling

    def __post_init__(self) -> None:
        _ = self.inflation  # refuses invalid values when the settings are read, not when the map arrives

    @property
    def inflation(self) -> Inflation:
        """The inflation of these settings."""
        return Inflation(
            inscribed_radius=self.inscribed_radius,
            inflation_radius=self.inflation_radius,
            cost_scaling=self.cost_scaling,
        )


def _hook(kind: type, value: object) -> object:
    if kind in (Path, Secret) and isinstance(value, str):
        return kind(value)
    raise TypeError(f"expected text, not {type(value).__name__}")


def _converted(value: object, kind: Any, *, strict: bool, where: str, remedy: str) -> Any:  # noqa: ANN401  # `int | None` is no `type` to mypy
    try:
        return msgspec.convert(value, kind, strict=strict, dec_hook=_hook)
    except msgspec.ValidationError as error:
        raise SettingsError(f"{where}: {error}. {remedy}") from error


def _read(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(file.read_text("utf-8"))
    except OSError as error:
        raise SettingsError(
            f"settings file {file} can't be read: {error.strerror}. Create it or name another"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"settings file {file} is not valid TOML: {error}. Correct that line") from error


def load(cls: type[S], *, prefix: str = "FOGNAV_", file: Path | None = None, environ: Mapping[str, str]) -> S:
    """Read the settings: the variable FOGNAV_FIELD overrides `field` in the file, which overrides the default.

    An empty variable counts as unset, because compose files pass empty ones. Raises `SettingsError`.
    """
    in_file = _read(file) if file else {}
    fields = {field.name: field for field in msgspec.structs.fields(cls)}
    if unknown := sorted(set(in_file) - set(fields)):
        known = ", ".join(sorted(fields))
        raise SettingsError(f"{file}: unknown setting {unknown[0]!r}. Remove it or use one of: {known}")
    values: dict[str, Any] = {}
    for name, field in fields.items():
        variable = prefix + name.upper()
        if text := environ.get(variable):
            remedy = f"Correct the environment variable {variable} (it is {_shown(field.type, text)})"
            values[name] = _converted(text, field.type, strict=False, where=variable, remedy=remedy)
        elif name in in_file:
            where = f"{file}: {name}"
            values[name] = _converted(in_file[name], field.type, strict=True, where=where, remedy="Correct it there")
        elif field.required:
            place = f" or `{name}` in {file}" if file else ""
            raise SettingsError(f"setting {name} is missing. Set the environment variable {variable}{place}")
    try:
        return cls(**values)
    except ValueError as error:  # from the class's own __post_init__
        raise SettingsError(f"the settings are inconsistent: {error}") from error


def _shown(kind: object, text: str) -> str:
    return "***" if kind is Secret or kind == Secret | None else repr(_PASSWORD.sub(r"\1:***@", text))


def describe(settings: msgspec.Struct) -> dict[str, object]:
    """Return the settings as plain values for the log, without secrets and passwords in URLs."""
    shown: dict[str, object] = {}
    for name in settings.__struct_fields__:
        value = getattr(settings, name)
        if value is None or isinstance(value, bool | int | float):
            shown[name] = value
        else:
            shown[name] = _PASSWORD.sub(r"\1:***@", str(value))
    return shown
