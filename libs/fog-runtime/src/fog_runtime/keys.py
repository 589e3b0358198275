"""The secrets of a site: `python -m fog_runtime.keys DIR` creates those missing in DIR and keeps the others.

- `admin.token`: a bearer token for REST writes; `tokens.toml`: its hash, for the services (FOGNAV_TOKENS_FILE).
- `operator.key`: the key that signs commands to robots (FOGNAV_OPERATOR_KEY_FILE), hexadecimal.
"""

import os
import secrets
import sys
from pathlib import Path
from typing import Final

from fog_contracts.commands import KEY_BYTES
from fog_runtime.token_file import TOKEN_BYTES, token_hash

ADMIN_TOKEN: Final = "admin.token"  # noqa: S105  # a file's name
TOKENS: Final = "tokens.toml"
OPERATOR_KEY: Final = "operator.key"


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
    token_file, tokens_file, key_file = (directory / name for name in (ADMIN_TOKEN, TOKENS, OPERATOR_KEY))
    if token_file.exists() and not tokens_file.exists():
        raise FileExistsError(f"{token_file} exists, but {tokens_file} does not: remove the one or restore the other")
    if not tokens_file.exists():
        token = secrets.token_urlsafe(TOKEN_BYTES)
        _write_new(token_file, token + "\n", mode)
        _write_new(tokens_file, f'[[tokens]]\nname = "admin"\nrole = "admin"\nsha256 = "{token_hash(token)}"\n', mode)
        created += [token_file, tokens_file]
    if not key_file.exists():
        _write_new(key_file, secrets.token_hex(KEY_BYTES) + "\n", mode)
        created.append(key_file)
    return created


def main() -> int:
    """Create the missing secrets in the folder that the command line names."""
    if len(sys.argv) != 2:
        sys.stderr.write("usage: python -m fog_runtime.keys DIR\n")
        return 2
    try:
        created = make_keys(Path(sys.argv[1]))
    except OSError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    for file in created:
        sys.stdout.write(f"created {file}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
