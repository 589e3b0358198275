"""`fognav token`, `ca` and `robot add`: who may use the REST APIs, a site's authority, and a robot's credentials.

With the authority come the users and access lists of the servers.
"""

import datetime as dt
import os
from pathlib import Path
from typing import Annotated, Final

import typer

from fog_runtime.configuration.site import load_site
from fog_runtime.credentials import to_toml
from fog_runtime.files import atomic_write
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.token_file import Role, create_token, read_tokens, revoke_token
from fognav import checkout
from fognav.aside import require_no_upgrade
from fognav.credentials import (
    CredentialsOption,
    FloorOption,
    changeable_security,
    credentials_folder,
    named_folder,
    open_security,
    own_hosts,
    require_changeable,
    security_errors,
    user_on,
)
from fognav.operate.fog import find_fog
from fognav.operate.options import FogOption, JsonOption, checked_id
from fognav.output import (
    NOT_TRUE,
    FailedError,
    WrongUseError,
    exit_codes,
    print_answer,
    print_json,
    print_line,
    print_result,
)

token_app = typer.Typer(help="Create, list and revoke tokens of the REST APIs.", no_args_is_help=True)

_VARIABLE: Final = "FOGNAV_TOKENS_FILE"
_TOKENS: Final = "tokens.toml"

FileOption = Annotated[
    Path | None,
    typer.Option(
        "--file", metavar="F", help=f"The services' tokens file; default: {_VARIABLE}, else that of the system here."
    ),
]
NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Who uses it; audit entries show this name.")]


@token_app.command("create", epilog="Example: fognav token create anna --role operator --file /run/fognav/tokens.toml")
def token_create(  # noqa: PLR0913  # each option is an argument
    name: NameArgument,
    *,
    role: Annotated[
        Role,
        typer.Option("--role", help="guest may log in, viewer reads, operator writes, admin also recovers."),
    ] = "viewer",
    file: FileOption = None,
    fog: FogOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Write it there, as credentials (FOGNAV_CREDENTIALS_FILE)."),
    ] = None,
    security: CredentialsOption = None,
    json: JsonOption = False,
) -> None:
    """Create a token and print it, or write it to a file.

    Only its hash is stored: it can't be shown again. The running services accept it at once.
    """
    with exit_codes(), security_errors():
        if out is not None and out.exists():
            raise WrongUseError(f"{out} already exists: name another file with --out, or remove it")
        authority = open_security(security).authority.trusted if credentials_folder(security) is not None else ""
        token = create_token(_changeable_tokens(file, fog), name, role)
        if out is not None:
            text = to_toml(name, authority=authority, passwords={}, token=token)
            atomic_write(out, text.encode())
            line = f"wrote {out}: give it to {name}, who names it in FOGNAV_CREDENTIALS_FILE"
            print_result({"name": name, "role": role, "credentials": str(out)}, line, json=json)
        else:
            print_result({"name": name, "role": role, "token": token}, token, json=json)


@token_app.command("list", epilog="Example: fognav token list --json")
def token_list(*, file: FileOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """List who has a token, in which role."""
    with exit_codes():
        entries = read_tokens(_tokens_file(file, fog))
        tokens = [{"name": entry.name, "role": entry.role, "created": entry.created} for entry in entries]
        lines = [f"{each.name}: {each.role}" + (f", since {each.created}" if each.created else "") for each in entries]
        print_result({"tokens": tokens}, *lines, json=json)


@token_app.command("revoke", epilog="Example: fognav token revoke anna")
def token_revoke(
    name: NameArgument, *, file: FileOption = None, fog: FogOption = None, json: JsonOption = False
) -> None:
    """Revoke a token: the services refuse it from their next request on."""
    with exit_codes():
        revoke_token(_changeable_tokens(file, fog), name)
        print_result({"name": name, "revoked": True}, f"the token of {name} is revoked", json=json)


def _tokens_file(given: Path | None, fog: str | None) -> Path:
    """Return the tokens file; raises `WrongUseError` when there is none to find, or a choice."""
    if given is not None:
        return given
    if fog is None and (named := os.environ.get(_VARIABLE)):
        return Path(named)
    try:
        token_file = find_fog(fog).system.token_file
    except FailedError:
        token_file = None
    if token_file is None:
        raise WrongUseError(f"name the services' tokens file with --file or {_VARIABLE}")
    return Path(token_file).with_name(_TOKENS)


def _changeable_tokens(given: Path | None, fog: str | None) -> Path:
    """Return the tokens file; raises as `_tokens_file`, and `FailedError` while its fog node is upgraded."""
    file = _tokens_file(given, fog)
    require_no_upgrade(file)
    return file


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
    security: CredentialsOption = None,
    json: JsonOption = False,
) -> None:
    """Create a site's certificate authority, its servers' certificates, and a file of credentials for each user.

    Users are the services, the tools, and the robots and nodes of the site. What is there already stays.
    """
    with exit_codes(), security_errors():
        loaded = load_site(checkout.site_folder(site)).site
        require_changeable(named_folder(security))
        made = SiteSecurity(named_folder(security), loaded.id)
        made.make(
            host or own_hosts(),
            robots=[robot.id for robot in loaded.robots],
            nodes=loaded.senders,
        )
        _show(made, json=json)


@ca_app.command("issue", epilog="Example: fognav ca issue --host fog.local --host 192.168.7.1")
def ca_issue(*, host: HostOption = None, security: CredentialsOption = None, json: JsonOption = False) -> None:
    """Issue new certificates for all servers, for the names and addresses of before or those given."""
    with exit_codes(), security_errors():
        opened = changeable_security(security)
        opened.renew(host, only_due=False)
        _show(opened, json=json)


@ca_app.command("rotate", epilog="Example: fognav ca rotate, and when all have new credentials: ... --finish")
def ca_rotate(
    *,
    finish: Annotated[bool, typer.Option("--finish", help="Trust the authority before no longer.")] = False,
    security: CredentialsOption = None,
    json: JsonOption = False,
) -> None:
    """Replace the certificate authority, while everything runs.

    Until --finish both are trusted, and who knows only the old one accepts the new certificates, too: hand out the
    credentials again (robots, nodes, people) at any time before.
    """
    with exit_codes(), security_errors():
        opened = changeable_security(security)
        if finish:
            opened.authority.finish()
        else:
            opened.authority.rotate(now=dt.datetime.now(dt.UTC))
        opened.trust_again()
        opened.renew(only_due=False)
        _show(opened, json=json)


@ca_app.command("show", epilog="Example: fognav ca show --json")
def ca_show(*, security: CredentialsOption = None, json: JsonOption = False) -> None:
    """Show until when the authority and the servers' certificates are valid; the exit code is 1 if one expires soon."""
    with exit_codes(), security_errors():
        opened = open_security(security)
        _show(opened, json=json)
        if opened.expiring():
            raise typer.Exit(NOT_TRUE)


def _show(security: SiteSecurity, *, json: bool) -> None:
    expiries = security.expiries()
    if json:
        print_json(
            {
                "locks": str(security.directory),
                "rotating": security.authority.rotating,
                "valid_until": {name: until.isoformat() for name, until in expiries.items()},
                "expiring": security.expiring(),
                "credentials": sorted(security.users()),
            }
        )
        return
    for name, until in expiries.items():
        print_answer(f"{name:10} valid until {until:%Y-%m-%d}" + (", renew it" if name in security.expiring() else ""))
    if security.authority.rotating:
        print_answer("the authority before is still trusted: fognav ca rotate --finish ends that")
    print_answer(f"credentials in {security.directory}/credentials: {', '.join(sorted(security.users()))}")
    print_answer(_RELOAD)


def robot_add(
    robot: Annotated[str, typer.Argument(metavar="ROBOT", help="The robot's id: a to z, 0 to 9 and -.")],
    *,
    floor: FloorOption = None,
    security: CredentialsOption = None,
    remove: Annotated[bool, typer.Option("--remove", help="Let it in no longer.")] = False,
    json: JsonOption = False,
) -> None:
    """Let a robot into a site's fog, with a file of credentials.

    The robot needs it as FOGNAV_CREDENTIALS_FILE.
    For a robot that is known already they are new ones, and those of before are worth nothing any more.
    """
    with exit_codes(), security_errors():
        opened = changeable_security(security)
        user = user_on(opened, floor, checked_id(robot))
        file = None if remove else opened.add_robot(user)
        if remove and not opened.remove(user):
            raise WrongUseError(f"there is no robot {user}. Known are: {', '.join(sorted(opened.users()))}")
        line = (
            f"the router refuses {user} once it was restarted"
            if file is None
            else f"wrote {file}: copy it to the robot, for its owner only, and delete it here"
        )
        values = {"robot": robot, "credentials": None if file is None else str(file)}
        print_result(values, line, json=json, write=print_line)
