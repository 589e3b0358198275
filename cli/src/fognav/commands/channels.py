"""`fognav channels`: print what the channel table generates, or update the generated files of the checkout."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003  # Typer reads annotations at run time
from typing import Annotated, Literal

import typer

from fognav import checkout
from fognav.output import NOT_TRUE, WrongUseError, console, exit_codes


def channels_command(
    *,
    format: Annotated[  # noqa: A002  # the name of the option
        Literal["markdown", "acl", "header"], typer.Option("--format", help="What to print.")
    ] = "markdown",
    broker: Annotated[
        Literal["mqtt", "zenoh"] | None, typer.Option("--broker", help="For acl: only this broker's list.")
    ] = None,
    site: Annotated[
        Path | None,
        typer.Option("--site", metavar="D", help="For acl: only this site, its robots listed by id."),
    ] = None,
    write: Annotated[bool, typer.Option("--write", help="Write all generated files of the checkout.")] = False,
    check: Annotated[bool, typer.Option("--check", help="List the generated files that are out of date.")] = False,
) -> None:
    """Print what the channel table generates.

    This is the document of all messages and routes, the brokers' access control lists, or the firmware's header.
    """
    with exit_codes():
        _run(format, broker, site, write=write, check=check)


def _run(format: str, broker: str | None, site: Path | None, *, write: bool, check: bool) -> None:  # noqa: A002  # same
    from fog_contracts.generate.header import firmware_header  # noqa: PLC0415  # keeps the other commands fast
    from fog_runtime.configuration.site import SiteError  # noqa: PLC0415  # same
    from fognav import generated  # noqa: PLC0415  # same

    if format != "acl" and (broker or site):
        raise WrongUseError(f"--broker and --site apply only to --format acl, not to {format}")
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
