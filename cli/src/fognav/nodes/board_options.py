"""The options of the commands that write a board's settings, defined once, and what they write."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, cast

import typer

from fog_contracts.site import NodeSite
from fog_runtime.configuration.site import LoadedSite
from fognav.locking import LocksOption, locks_errors, locks_folder, open_locks
from fognav.nodes import provisioning
from fognav.operate.options import JsonOption
from fognav.output import print_json, print_line

SITE: Final = Path("estig")
SiteOption = Annotated[Path, typer.Option("--site", metavar="D", help="Folder of the site, or a name in sites/.")]
_TLS_PORT: Final = 8883
_OPEN_PORT: Final = 1883


@dataclass(frozen=True, kw_only=True)
class BoardOptions:
    """The options of a board's settings; `with_board_options` gives them to a command."""

    wifi: Annotated[str, typer.Option("--wifi", metavar="NAME", help="Name of the Wi-Fi network.")]
    wifi_password: Annotated[
        str,
        typer.Option("--wifi-password", envvar="FOGNAV_WIFI_PASSWORD", help="Its password; better in the variable."),
    ] = ""
    site: SiteOption = SITE
    fog_host: Annotated[str, typer.Option("--fog-host", metavar="HOST", help="The fog node's name for the boards.")] = (
        "fog.local"
    )
    tls: Annotated[bool, typer.Option("--tls/--no-tls", help="Whether the broker's connections are encrypted.")] = True
    passwords: Annotated[
        Path | None,
        typer.Option("--passwords", metavar="F", help="Mosquitto's password file, which gets the node's password."),
    ] = None
    locks: LocksOption = None
    profile: Annotated[
        Literal["standard", "thesis"],
        typer.Option("--profile", help="How it is wired: docs/hardware.md draws both."),
    ] = "standard"
    out: Annotated[
        Path,
        typer.Option("--out", metavar="DIR", help="Where to write node.json; firmware/data is what pio uploads."),
    ] = Path("firmware/data")
    json: JsonOption = False

    @property
    def target(self) -> Path:
        """The file of the board's settings."""
        return self.out / provisioning.SETTINGS_FILE

    def provision(self, loaded: LoadedSite, node: NodeSite) -> None:
        """Write a board's settings with a new password, and let it in where `locks` or `passwords` say so.

        Raises `WrongUseError`, and `FailedError` for locks that can't be used.
        """
        port = _TLS_PORT if self.tls else _OPEN_PORT
        access = provisioning.Access(self.wifi, self.wifi_password, self.fog_host, port, self.tls)
        members = provisioning.settings(loaded.site.id, node, access, provisioning.new_password(), self.profile)
        provisioning.provision(self.target, self._let_in(members), self.passwords)

    def _let_in(self, members: dict[str, Any]) -> dict[str, Any]:
        """Return the settings with the password that the site's locks give, and write beside them whom to trust."""
        if (folder := locks_folder(self.locks)) is None:
            return members
        with locks_errors():
            password, authority = provisioning.let_in(open_locks(folder), members["user"])
        provisioning.write_authority(self.target.with_name(provisioning.AUTHORITY_FILE), authority)
        return {**members, "password": password}

    def report(self, verb: str, node: NodeSite) -> None:
        """Print what was written, and what to do with it."""
        if self.json:
            limits = [sonar.range_limit for sonar in node.sonars]
            values = {"node": node.id, "file": str(self.target), "range_limit_m": limits}
            print_json({**values, "passwords": None if self.passwords is None else str(self.passwords)})
            return
        words = " and ".join(f"{sonar.range_limit:.2f}" for sonar in node.sonars)
        print_line(f"{verb} {node.id} in area {node.area}: blocked below {words} m")
        print_line(f"wrote {self.target}: flash it (firmware/README.md), then: fognav node calibrate {node.id}")
        print_line("the hazard-aggregator reads the site at its start: restart it")


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
