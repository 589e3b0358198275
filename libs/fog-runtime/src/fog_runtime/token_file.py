"""The tokens file: who may call the REST APIs in which role. It holds hashes only, and each change is logged beside it.

`python -m fog_runtime.token_file FILE create NAME ROLE`, `... list`, `... revoke NAME`: on a fog node, where the
command `fognav token` is not installed. The services notice a change with the next request.
"""

import argparse
import datetime as dt
import fcntl
import getpass
import hashlib
import json
import os
import secrets
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Final, Literal, get_args

import msgspec

from fog_runtime.files import atomic_write

Role = Literal["guest", "viewer", "operator", "admin"]
ROLES: Final = get_args(Role)
"""From the fewest rights to the most."""
TOKEN_BYTES: Final = 32

Name = Annotated[str, msgspec.Meta(pattern=r"^[\w .@-]{1,100}$(?!\n)")]


class TokensError(ValueError):
    """A tokens file is missing or invalid, or can't be changed so; the message names file, entry and remedy."""


class TokenEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A caller: the name that audit entries show, the role, the hash of the token, and when it was created."""

    name: Name
    role: Role
    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    created: str = ""


class _TokensFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    tokens: list[TokenEntry] = []


def token_hash(token: str) -> str:
    """Return the hash of a token, as in the tokens file (tokens are long and random, so a plain hash is enough)."""
    return hashlib.sha256(token.encode()).hexdigest()


def read_tokens(file: Path) -> list[TokenEntry]:
    """Return the entries of a tokens file (TOML: `[[tokens]]` with name, role, sha256); raises `TokensError`."""
    try:
        entries = msgspec.convert(tomllib.loads(file.read_text("utf-8")), _TokensFile).tokens
    except OSError as error:
        raise TokensError(f"{file}: can't be read ({error.strerror}). Create it or unset FOGNAV_TOKENS_FILE") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise TokensError(f"{file}: is not valid TOML ({error}). Correct that line") from error
    except msgspec.ValidationError as error:
        raise TokensError(f"{file}: {error}. Each of [[tokens]] needs name, role and sha256") from error
    if len({entry.sha256 for entry in entries}) != len(entries):
        raise TokensError(f"{file}: two entries have the same sha256. Give each caller a token of their own")
    return entries


def create_token(file: Path, name: str, role: Role) -> str:
    """Add a caller to a tokens file and return the new token, which is stored nowhere; raises `TokensError`."""
    token = secrets.token_urlsafe(TOKEN_BYTES)
    created = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
    try:
        entry = msgspec.convert(
            {"name": name, "role": role, "sha256": token_hash(token), "created": created}, TokenEntry
        )
    except msgspec.ValidationError as error:
        raise TokensError(
            f"{name!r} can't have the role {role!r}: a name has up to 100 letters, digits, spaces and . @ _ -, "
            f"and the roles are {', '.join(ROLES)}"
        ) from error

    def add(entries: list[TokenEntry]) -> list[TokenEntry]:
        if any(known.name == name for known in entries):
            raise TokensError(f"{file}: {name} has a token already. Revoke it first, or choose another name")
        return [*entries, entry]

    _change(file, add, action="create", name=name, role=role)
    return token


def revoke_token(file: Path, name: str) -> None:
    """Remove a caller from a tokens file; raises `TokensError`."""

    def remove(entries: list[TokenEntry]) -> list[TokenEntry]:
        rest = [entry for entry in entries if entry.name != name]
        if len(rest) == len(entries):
            names = ", ".join(entry.name for entry in entries) or "nobody"
            raise TokensError(f"{file}: {name} has no token. Tokens have: {names}")
        return rest

    _change(file, remove, action="revoke", name=name)


def keep_token(tokens: Path, name: str, role: Role, file: Path, *, owner: int | None = None) -> None:
    """Give a program a token of its own in `file`, unless the one there is valid; raises `TokensError`, `OSError`."""
    known = [entry for entry in read_tokens(tokens) if entry.name == name]
    if known:
        if file.exists() and token_hash(file.read_text("ascii").strip()) == known[0].sha256:
            return
        revoke_token(tokens, name)
    atomic_write(file, f"{create_token(tokens, name, role)}\n".encode(), owner=owner)


def _change(file: Path, change: Callable[[list[TokenEntry]], list[TokenEntry]], *, action: str, **changed: str) -> None:
    """Replace the entries under a lock; the audit entry is written first, so that no change goes without one."""
    at = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
    entry = {"at": at, "who": getpass.getuser(), "action": action, **changed}
    try:
        with _locked(file):
            entries = change(read_tokens(file))
            with audit_file(file).open("a", encoding="utf-8") as audit:
                audit.write(json.dumps(entry, ensure_ascii=False) + "\n")
            before = file.stat()
            atomic_write(file, _to_toml(entries).encode())
            file.chmod(before.st_mode & 0o777)
            if os.geteuid() == 0:
                os.chown(file, before.st_uid, before.st_gid)  # the services, which are not root, must read it
    except OSError as error:
        raise TokensError(f"{file}: can't be changed ({error.strerror}). Run this as its owner") from error


def audit_file(file: Path) -> Path:
    """Return the audit log of a tokens file: one JSON object per line with at, who, action, name and role."""
    return file.with_suffix(".audit.jsonl")


@contextmanager
def _locked(file: Path) -> Iterator[None]:
    descriptor = os.open(file.with_suffix(".lock"), os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _to_toml(entries: list[TokenEntry]) -> str:
    # All values consist of characters that stand for themselves in a TOML string.
    tables = [
        "[[tokens]]\n" + "".join(f'{name} = "{value}"\n' for name, value in msgspec.to_builtins(entry).items())
        for entry in entries
    ]
    return "\n".join(tables)


def main() -> int:
    """Create, list or revoke tokens as the command line says; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m fog_runtime.token_file")
    parser.add_argument("file", type=Path)
    actions = parser.add_subparsers(dest="action", required=True)
    create = actions.add_parser("create")
    create.add_argument("name")
    create.add_argument("role", choices=ROLES)
    actions.add_parser("list")
    actions.add_parser("revoke").add_argument("name")
    given = parser.parse_args()
    try:
        if given.action == "create":
            sys.stdout.write(create_token(given.file, given.name, given.role) + "\n")
        elif given.action == "revoke":
            revoke_token(given.file, given.name)
        else:
            for entry in read_tokens(given.file):
                sys.stdout.write(f"{entry.name}: {entry.role}\n")
    except TokensError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
