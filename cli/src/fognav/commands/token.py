"""`fognav token`: create, list and revoke the tokens of the REST APIs."""

import os
from pathlib import Path
from typing import Annotated, Final

import typer

from fog_runtime.credentials import to_toml
from fog_runtime.files import atomic_write
from fog_runtime.token_file import Role, TokensError, create_token, read_tokens, revoke_token
from fognav.locking import LocksOption, locks_errors, locks_folder, open_locks
from fognav.operate.fog import find_fog
from fognav.operate.options import JsonOption
from fognav.output import FailedError, WrongUseError, exit_codes, print_answer, print_json

token_app = typer.Typer(help="Create, list and revoke tokens of the REST APIs.", no_args_is_help=True)

_VARIABLE: Final = "FOGNAV_TOKENS_FILE"
_TOKENS: Final = "tokens.toml"

FileOption = Annotated[
    Path | None,
    typer.Option(
        "--file", metavar="F", help=f"The services' tokens file; default: {_VARIABLE}, else a running demo's."
    ),
]
NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Who uses it; audit entries show this name.")]


@token_app.command("create", epilog="Example: fognav token create anna --role operator --file /run/fognav/tokens.toml")
def token_create(
    name: NameArgument,
    *,
    role: Annotated[
        Role, typer.Option("--role", help="viewer reads, operator writes, admin also recovers.")
    ] = "viewer",
    file: FileOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Write it there, as credentials (FOGNAV_CREDENTIALS_FILE)."),
    ] = None,
    locks: LocksOption = None,
    json: JsonOption = False,
) -> None:
    """Create a token and print it, or write it to a file.

    Only its hash is stored: it can't be shown again. The running services accept it at once.
    """
    with exit_codes(), locks_errors():
        if out is not None and out.exists():
            raise WrongUseError(f"{out} already exists: name another file with --out, or remove it")
        authority = open_locks(locks).authority.trusted if locks_folder(locks) is not None else ""
        try:
            token = create_token(_file(file), name, role)
        except TokensError as error:
            raise FailedError(str(error)) from error
        if out is not None:
            text = to_toml(name, authority=authority, passwords={}, token=token)
            atomic_write(out, text.encode())
            if json:
                print_json({"name": name, "role": role, "credentials": str(out)})
            else:
                print_answer(f"wrote {out}: give it to {name}, who names it in FOGNAV_CREDENTIALS_FILE")
        elif json:
            print_json({"name": name, "role": role, "token": token})
        else:
            typer.echo(token)


@token_app.command("list", epilog="Example: fognav token list --json")
def token_list(*, file: FileOption = None, json: JsonOption = False) -> None:
    """List who has a token, in which role."""
    with exit_codes():
        try:
            entries = read_tokens(_file(file))
        except TokensError as error:
            raise FailedError(str(error)) from error
        if json:
            tokens = [{"name": entry.name, "role": entry.role, "created": entry.created} for entry in entries]
            print_json({"tokens": tokens})
            return
        for entry in entries:
            print_answer(f"{entry.name}: {entry.role}" + (f", since {entry.created}" if entry.created else ""))


@token_app.command("revoke", epilog="Example: fognav token revoke anna")
def token_revoke(name: NameArgument, *, file: FileOption = None, json: JsonOption = False) -> None:
    """Revoke a token: the services refuse it from their next request on."""
    with exit_codes():
        try:
            revoke_token(_file(file), name)
        except TokensError as error:
            raise FailedError(str(error)) from error
        if json:
            print_json({"name": name, "revoked": True})
        else:
            print_answer(f"the token of {name} is revoked")


def _file(given: Path | None) -> Path:
    """Return the tokens file; raises `WrongUseError` when there is none to find."""
    if given is not None:
        return given
    if named := os.environ.get(_VARIABLE):
        return Path(named)
    try:
        token_file = find_fog(None).system.token_file
    except FailedError:
        token_file = None
    if token_file is None:
        raise WrongUseError(f"name the services' tokens file with --file or {_VARIABLE}")
    return Path(token_file).with_name(_TOKENS)
