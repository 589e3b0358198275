"""The secrets of a site, as files of one folder.

- `admin.token`: a bearer token for REST writes; `tokens.toml`: its hash, for the services (FOGNAV_TOKENS_FILE).
- `operator.key`: the key that signs commands to robots (FOGNAV_OPERATOR_KEY_FILE), hexadecimal.
- `session.key`: the key that signs sessions of the console (FOGNAV_SESSION_KEY_FILE), hexadecimal.
"""

from __future__ import annotations

import os
import secrets
from typing import TYPE_CHECKING, Final

from fog_contracts.commands import KEY_BYTES
from fog_runtime.token_file import TOKEN_BYTES, token_hash

if TYPE_CHECKING:
    from pathlib import Path

ADMIN_TOKEN: Final = "admin.token"  # noqa: S105  # a file's name
BRIDGE_TOKEN: Final = "bridge.token"  # noqa: S105  # same
"""That of the bridge to other systems, where one runs (`fog_runtime.token_file.keep_token`)."""
TOKENS: Final = "tokens.toml"
OPERATOR_KEY: Final = "operator.key"
SESSION_KEY: Final = "session.key"


def _write_new(file: Path, text: str, mode: int) -> None:
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
        stream.write(text)


def make_keys(directory: Path, *, mode: int = 0o600) -> list[Path]:
    """Create the missing secrets; return the new files.

    A token is useless without its entry in `tokens.toml`, so these two are created together: raises `FileExistsError`
    when only `admin.token` exists. Without it, `tokens.toml` is complete: the token may be kept elsewhere.
    """
    directory.mkdir(parents=True, exist_ok=True)
    created: list[Path] = []
    token_file, tokens_file = directory / ADMIN_TOKEN, directory / TOKENS
    if token_file.exists() and not tokens_file.exists():
        raise FileExistsError(f"{token_file} exists, but {tokens_file} does not: remove the one or restore the other")
    if not tokens_file.exists():
        token = secrets.token_urlsafe(TOKEN_BYTES)
        _write_new(token_file, token + "\n", mode)
        _write_new(tokens_file, f'[[tokens]]\nname = "admin"\nrole = "admin"\nsha256 = "{token_hash(token)}"\n', mode)
        created += [token_file, tokens_file]
    for key_file in (directory / OPERATOR_KEY, directory / SESSION_KEY):
        if not key_file.exists():
            _write_new(key_file, secrets.token_hex(KEY_BYTES) + "\n", mode)
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
