"""`fognav ca`: the site's own certificate authority, and with it the users and access lists of its servers."""

import datetime as dt
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fognav import checkout
from fognav.locking import LocksOption, locks_errors, named_folder, open_locks, own_hosts
from fognav.nodes import site_file
from fognav.operate.options import JsonOption
from fognav.output import NOT_TRUE, exit_codes, print_answer, print_json

if TYPE_CHECKING:
    from fog_runtime.locks.site_locks import SiteLocks

ca_app = typer.Typer(help="Create, renew and replace certificates of a site's servers.", no_args_is_help=True)

_SITE = "estig"
HostOption = Annotated[
    list[str] | None,
    typer.Option(
        "--host", metavar="NAME|ADDRESS", help="How clients reach the servers; may be repeated. Default: this computer."
    ),
]
_RELOAD = "the servers use it after a restart; Mosquitto after SIGHUP, too"


@ca_app.command("create", epilog="Example: fognav ca create --site sites/floor --credentials DIR --host fog.local")
def ca_create(
    *,
    site: Annotated[Path, typer.Option("--site", metavar="D", help="Folder of the site, or a name in sites/.")] = Path(
        _SITE
    ),
    host: HostOption = None,
    locks: LocksOption = None,
    json: JsonOption = False,
) -> None:
    """Create a site's certificate authority, its servers' certificates, and a file of credentials for each user.

    Users are the services, the tools, and the robots and nodes of the site. What is there already stays.
    """
    from fog_runtime.locks.site_locks import SiteLocks  # noqa: PLC0415  # keeps the other commands fast

    with exit_codes(), locks_errors():
        loaded = site_file.load(checkout.site_folder(site)).site
        made = SiteLocks(named_folder(locks), loaded.id)
        made.make(
            host or own_hosts(),
            robots=[robot.id for robot in loaded.robots],
            nodes=[node.id for node in loaded.nodes],
        )
        _show(made, json=json)


@ca_app.command("issue", epilog="Example: fognav ca issue --host fog.local --host 192.168.7.1")
def ca_issue(*, host: HostOption = None, locks: LocksOption = None, json: JsonOption = False) -> None:
    """Issue new certificates for all servers, for the names and addresses of before or those given."""
    with exit_codes(), locks_errors():
        opened = open_locks(locks)
        opened.renew(host, only_due=False)
        _show(opened, json=json)


@ca_app.command("rotate", epilog="Example: fognav ca rotate, and when all have new credentials: ... --finish")
def ca_rotate(
    *,
    finish: Annotated[bool, typer.Option("--finish", help="Trust the authority before no longer.")] = False,
    locks: LocksOption = None,
    json: JsonOption = False,
) -> None:
    """Replace the certificate authority, while everything runs.

    Until --finish both are trusted, and who knows only the old one accepts the new certificates, too: hand out the
    credentials again (robots, nodes, people) at any time before.
    """
    with exit_codes(), locks_errors():
        opened = open_locks(locks)
        if finish:
            opened.authority.finish()
        else:
            opened.authority.rotate(now=dt.datetime.now(dt.UTC))
        opened.trust_again()
        opened.renew(only_due=False)
        _show(opened, json=json)


@ca_app.command("show", epilog="Example: fognav ca show --json")
def ca_show(*, locks: LocksOption = None, json: JsonOption = False) -> None:
    """Show until when the authority and the servers' certificates are valid; the exit code is 1 if one expires soon."""
    with exit_codes(), locks_errors():
        opened = open_locks(locks)
        _show(opened, json=json)
        if opened.expiring():
            raise typer.Exit(NOT_TRUE)


def _show(locks: "SiteLocks", *, json: bool) -> None:
    expiries = locks.expiries()
    if json:
        print_json(
            {
                "locks": str(locks.directory),
                "rotating": locks.authority.rotating,
                "valid_until": {name: until.isoformat() for name, until in expiries.items()},
                "expiring": locks.expiring(),
                "credentials": sorted(locks.users()),
            }
        )
        return
    for name, until in expiries.items():
        print_answer(f"{name:10} valid until {until:%Y-%m-%d}" + (", renew it" if name in locks.expiring() else ""))
    if locks.authority.rotating:
        print_answer("the authority before is still trusted: fognav ca rotate --finish ends that")
    print_answer(f"credentials in {locks.directory}/credentials: {', '.join(sorted(locks.users()))}")
    print_answer(_RELOAD)
