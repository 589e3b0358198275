"""`fognav channels`: print what the channel table generates, or bring the files of the checkout up to date."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003  # Typer reads annotations at run time
from typing import Annotated, Literal

import typer

from fognav import checkout
from fognav.output import NOT_TRUE, WRONG_USE, WrongUseError, console


def channels_command(
    *,
    format: Annotated[  # noqa: A002  # the name of the option
        Literal["markdown", "acl", "header"], typer.Option("--format", help="What to print.")
    ] = "markdown",
    broker: Annotated[
        Literal["mqtt", "zenoh"] | None, typer.Option("--broker", help="Of acl: only this one's list.")
    ] = None,
    site: Annotated[
        Path | None,
        typer.Option("--site", metavar="D", help="Of acl: for this site only, its robots known by their ids."),
    ] = None,
    write: Annotated[bool, typer.Option("--write", help="Write all generated files of the checkout instead.")] = False,
    check: Annotated[bool, typer.Option("--check", help="Say which generated files are stale instead.")] = False,
) -> None:
    """Print what the channel table generates.

    That is its document with all messages and routes, the brokers' access control lists, and the firmware's header.
    """
    try:
        _run(format, broker, site, write=write, check=check)
    except WrongUseError as error:
        console.print(f"fognav: {error}", markup=False, style="red")
        raise typer.Exit(WRONG_USE) from error


def _run(format: str, broker: str | None, site: Path | None, *, write: bool, check: bool) -> None:  # noqa: A002  # same
    from fog_contracts.generate.header import firmware_header  # noqa: PLC0415  # the others need not wait for it
    from fog_runtime.site import SiteError  # noqa: PLC0415  # same
    from fognav import generated  # noqa: PLC0415  # same

    if format != "acl" and (broker or site):
        raise WrongUseError(f"--broker and --site belong to --format acl, not to {format}")
    if write:
        names = generated.write(checkout.root())
        console.print(f"wrote {', '.join(names)}" if names else "all generated files are up to date", markup=False)
    elif check:
        if names := generated.stale(checkout.root()):
            console.print(f"{', '.join(names)}: out of date. Run: {generated.WRITE}", markup=False, style="red")
            raise typer.Exit(NOT_TRUE)
    elif format == "markdown":
        _print(generated.markdown())
    elif format == "header":
        _print(firmware_header())
    else:
        try:
            mqtt, zenoh = generated.acls(checkout.site_folder(site) if site else None)
        except SiteError as error:
            raise WrongUseError(str(error)) from error
        for name, text in (("mqtt", mqtt), ("zenoh", zenoh)):
            if broker in (None, name):
                _print(text)


def _print(text: str) -> None:
    typer.echo(text, nl=False)
