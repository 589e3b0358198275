"""The secrets of a site, as files of one folder.

- `admin.token`: a bearer token for REST writes; `tokens.toml`: its hash, for the services (FOGNAV_TOKENS_FILE).
- `operator.key`: the key that signs commands to robots (FOGNAV_OPERATOR_KEY_FILE), hexadecimal.
- `session.key`: the key that signs sessions of the console (FOGNAV_SESSION_KEY_FILE), hexadecimal.
"""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Final

from fog_contracts.commands import KEY_BYTES
from fog_runtime.files import atomic_write
from fog_runtime.token_file import TOKEN_BYTES, token_hash

if TYPE_CHECKING:
    from pathlib import Path

ADMIN_TOKEN: Final = "admin.token"  # noqa: S105  # a file's name
BRIDGE_TOKEN: Final = "bridge.token"  # noqa: S105  # same
"""That of the bridge to other systems, where one runs (`fog_runtime.token_file.keep_token`)."""
TOKENS: Final = "tokens.toml"
OPERATOR_KEY: Final = "operator.key"
SESSION_KEY: Final = "session.key"


def make_keys(directory: Path) -> list[Path]:
    """Create the missing secrets, each whole and durably or not at all; return the new files. Raises `OSError`.

    A token is useless without its entry in `tokens.toml`, so these two are created together: raises `FileExistsError`
    when only `admin.token` exists. Without it, `tokens.toml` is complete: the token may be kept elsewhere.
    """
    created: list[Path] = []
    token_file, tokens_file = directory / ADMIN_TOKEN, directory / TOKENS
    if token_file.exists() and not tokens_file.exists():
        raise FileExistsError(f"{token_file} exists, but {tokens_file} does not: remove the one or restore the other")
    if not tokens_file.exists():
        token = secrets.token_urlsafe(TOKEN_BYTES)
        entry = f'[[tokens]]\nname = "admin"\nrole = "admin"\nsha256 = "{token_hash(token)}"\n'
        atomic_write(token_file, f"{token}\n".encode())
        try:
            atomic_write(tokens_file, entry.encode())
        except OSError:
            token_file.unlink()
            raise
        created += [token_file, tokens_file]
    for key_file in (directory / OPERATOR_KEY, directory / SESSION_KEY):
        if not key_file.exists():
            atomic_write(key_file, f"{secrets.token_hex(KEY_BYTES)}\n".encode())
            created.append(key_file)
    return created


class KeyFileError(ValueError):
    """A file is no key; the message names the file and the remedy."""


def read_operator_key(file: Path) -> bytes:
    """Return the key that signs commands to robots from a file with its hexadecimal digits (`operator.key`).

    Raises `KeyFileError`.
    """
    return _read_key(file, "operators' key")


def read_session_key(file: Path) -> bytes:
    """Return the key that signs sessions from a file with its hexadecimal digits (`session.key`).

    Raises `KeyFileError`.
    """
    return _read_key(file, "key of sessions")


def _read_key(file: Path, what: str) -> bytes:
    remedy = f"Write {2 * KEY_BYTES} or more hexadecimal digits into it (openssl rand -hex {KEY_BYTES})"
    try:
        key = bytes.fromhex(file.read_text("ascii").strip())
    except OSError as error:
        raise KeyFileError(f"the {what} {file} can't be read: {error.strerror}. {remedy}") from error
    except ValueError as error:
        raise KeyFileError(f"the {what} {file} is not hexadecimal. {remedy}") from error
    if len(key) < KEY_BYTES:
        raise KeyFileError(f"the {what} {file} is only {len(key)} bytes long. {remedy}")
    return key
