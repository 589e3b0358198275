"""The options of the commands that write a board's settings, defined once, and what they write."""

import functools
import inspect
import ipaddress
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, cast

import typer

from fog_contracts.site import NodeSite
from fog_runtime.configuration.site import LoadedSite
from fognav import checkout
from fognav.locking import LocksOption, locks_errors, locks_folder, open_locks
from fognav.nodes import provisioning
from fognav.operate.options import JsonOption
from fognav.output import WrongUseError, print_json, print_line

SITE: Final = Path("estig")
SiteOption = Annotated[Path, typer.Option("--site", metavar="D", help="Folder of the site, or a name in sites/.")]
_TLS_PORT: Final = 8883
_OPEN_PORT: Final = 1883
_WIFI_NAME_BYTES: Final = 32
_WIFI_PASSWORD: Final = re.compile(r"[ -~]{8,63}|[0-9A-Fa-f]{64}")
"""Of WPA2: a shorter one is no access point's, and no board's library takes a longer one."""
_HOST_NAME: Final = re.compile(r"(?=.{1,64}\Z)([A-Za-z0-9-]+\.)*[A-Za-z0-9-]*[A-Za-z][A-Za-z0-9-]*")
_IP: Final = 4
"""The boards' libraries are built without IPv6."""
_NOBODYS: Final = (0, 2**32 - 1)
_ESPHOME: Final = Path("firmware", "esphome", "fognav-node.yaml")
"""What ESPHome makes a node of; it reads the board's settings from beside its copy."""


@dataclass(frozen=True, kw_only=True)
class BoardOptions:
    """The options of a board's settings; `with_board_options` gives them to a command."""

    wifi: Annotated[str, typer.Option("--wifi", metavar="NAME", help="Name of the Wi-Fi network.")]
    wifi_password: Annotated[
        str | None,
        typer.Option(
            "--wifi-password",
            envvar="FOGNAV_WIFI_PASSWORD",
            help="Its password, empty for an open network; better in the variable. Asked for, if not given.",
        ),
    ] = None
    site: SiteOption = SITE
    fog_host: Annotated[
        str | None,
        typer.Option(
            "--fog-host", metavar="HOST", help="The fog node's address in the boards' network. Asked for, if not given."
        ),
    ] = None
    tls: Annotated[bool, typer.Option("--tls/--no-tls", help="Whether the broker's connections are encrypted.")] = True
    passwords: Annotated[
        Path | None,
        typer.Option("--passwords", metavar="F", help="Mosquitto's password file, which gets the node's password."),
    ] = None
    locks: LocksOption = None
    firmware: Annotated[
        Literal["fognav", "esphome"],
        typer.Option("--firmware", help="What will run on the board; esphome: on a D1 mini 32, with two HC-SR04."),
    ] = "fognav"
    profile: Annotated[
        Literal["standard", "thesis"],
        typer.Option("--profile", help="How it is wired: docs/hardware.md draws both."),
    ] = "standard"
    out: Annotated[
        Path,
        typer.Option("--out", metavar="DIR", help="Where to write the settings; firmware/data is what pio uploads."),
    ] = Path("firmware/data")
    json: JsonOption = False

    @property
    def target(self) -> Path:
        """The file of the board's settings."""
        return self.out / (provisioning.ESPHOME_FILE if self.firmware == "esphome" else provisioning.SETTINGS_FILE)

    def completed(self) -> Self:
        """Return the options with what was missing, asked for on a terminal.

        Raises `WrongUseError` for what can't work on a board, and without a terminal for what is missing.
        """
        password, host = self.wifi_password, self.fog_host
        if password is None:
            password = _asked(f"Password of the Wi-Fi network {self.wifi}", "--wifi-password", hidden=True)
        if host is None:
            host = _asked("The fog node's address in the boards' network", "--fog-host")
        self._check_wifi(password)
        self._check_host(host)
        self._check_trust(host)
        return replace(self, wifi_password=password, fog_host=host)

    def _check_wifi(self, password: str) -> None:
        if not 1 <= len(self.wifi.encode()) <= _WIFI_NAME_BYTES:
            raise WrongUseError(f"--wifi {self.wifi!r}: a network's name has 1 to {_WIFI_NAME_BYTES} bytes")
        if password and not _WIFI_PASSWORD.fullmatch(password):
            raise WrongUseError(
                f"--wifi-password: this one has {len(password)} characters, and that of a network has 8 to 63, from "
                "space to ~ (or its key, 64 hexadecimal digits). Correct it, or give an empty one for an open network"
            )

    def _check_host(self, host: str) -> None:
        address = _address(host)
        if host.lower() == "localhost" or (address is not None and address.is_loopback):
            raise WrongUseError(
                f"--fog-host {host}: on the board that is the board itself. Give the fog node's address"
            )
        if address is None and not _HOST_NAME.fullmatch(host):
            raise WrongUseError(
                f"--fog-host {host!r} is neither a name nor an address. Give the fog node's address and nothing else, "
                "such as 192.168.7.1"
            )
        if address is not None and (address.version != _IP or address.is_multicast or int(address) in _NOBODYS):
            raise WrongUseError(
                f"--fog-host {host}: no board connects to that. Give the fog node's own IPv4 address, such as "
                "192.168.7.1"
            )
        if self.firmware == "fognav" and host.lower().endswith(".local"):
            raise WrongUseError(
                f"--fog-host {host}: a D1 mini can't look up names in .local. Give the fog node's address"
            )

    def _check_trust(self, host: str) -> None:
        if not self.tls:
            if self.firmware == "esphome":
                raise WrongUseError(
                    "--no-tls: the configuration for ESPHome speaks TLS only. Give --credentials instead"
                )
            return
        folder = locks_folder(self.locks)
        if folder is None:
            if not self._authority.exists():
                raise WrongUseError(
                    "TLS, and nothing says whom the board shall trust: give the folder of the fog node's credentials "
                    f"(--credentials), put the certificate of the broker's authority into {self._authority}, or use "
                    "--no-tls for a broker without certificates"
                )
            return
        # The firmware compares a name as it is given, but of an address a name that is in the certificate anyway.
        if self.firmware == "fognav" and _address(host) is not None:
            return
        with locks_errors():
            known = open_locks(folder).hosts
        if host not in known:
            raise WrongUseError(
                f"--fog-host {host} is not in the broker's certificate, so the board would not trust it: it is for "
                f"{', '.join(known)}. Give one of them, or add yours (fognav up --host, fognav ca issue --host)"
            )

    @property
    def _authority(self) -> Path:
        return self.out / provisioning.AUTHORITY_FILE

    def provision(self, loaded: LoadedSite, node: NodeSite) -> None:
        """Write a board's settings with a new password, and let it in where `locks` or `passwords` say so.

        Raises `WrongUseError`, and `FailedError` for locks that can't be used.
        """
        if self.wifi_password is None or self.fog_host is None:
            raise TypeError("these options are not complete: see `completed`")
        port = _TLS_PORT if self.tls else _OPEN_PORT
        access = provisioning.Access(self.wifi, self.wifi_password, self.fog_host, port, self.tls)
        members = provisioning.settings(loaded.site.id, node, access, provisioning.new_password(), self.profile)
        if (folder := locks_folder(self.locks)) is not None:
            with locks_errors():
                members["password"], authority = provisioning.let_in(open_locks(folder), node.id)
            provisioning.write_authority(self._authority, authority)
        if self.firmware == "esphome":
            members = provisioning.esphome_secrets(members, self._authority)
            shutil.copyfile(checkout.root() / _ESPHOME, self.out / _ESPHOME.name)
        provisioning.provision(self.target, members, self.passwords)

    def report(self, verb: str, node: NodeSite) -> None:
        """Print what was written, and what to do with it."""
        if self.json:
            limits = [sonar.range_limit for sonar in node.sonars]
            values = {"node": node.id, "file": str(self.target), "range_limit_m": limits}
            print_json({**values, "passwords": None if self.passwords is None else str(self.passwords)})
            return
        words = " and ".join(f"{sonar.range_limit:.2f}" for sonar in node.sonars)
        print_line(f"{verb} {node.id} in area {node.area}: blocked below {words} m")
        if self.firmware == "esphome":
            print_line(f"wrote {self.target}, and what reads it: esphome run {self.out / _ESPHOME.name}")
        else:
            print_line(f"wrote {self.target}: flash it (firmware/README.md), then: fognav node calibrate {node.id}")
        print_line("the hazard-aggregator reads the site at its start: restart it")


def _asked(what: str, option: str, *, hidden: bool = False) -> str:
    """Return what a person answers; raises `WrongUseError` where nobody can be asked."""
    if not sys.stdin.isatty():
        raise WrongUseError(f"{option} is missing: {what[0].lower()}{what[1:]}")
    return str(typer.prompt(what, hide_input=hidden, default="" if hidden else None, show_default=False, err=True))


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def with_board_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command each field of `BoardOptions` as an option of its own; it gets them together, as `board`."""
    own = [each for each in inspect.signature(command).parameters.values() if each.name != "board"]
    options = list(inspect.signature(BoardOptions).parameters.values())

    @functools.wraps(command)
    def called(**values: Any) -> None:  # noqa: ANN401  # whatever options the command has
        board = BoardOptions(**{option.name: values.pop(option.name) for option in options})
        command(**values, board=board)

    # What the command line is read by; the wrapped command would have it without the board's options.
    bare = cast("Any", called)
    del bare.__wrapped__
    bare.__signature__ = inspect.Signature([*own, *options])
    bare.__annotations__ = {each.name: each.annotation for each in [*own, *options]}
    return called
