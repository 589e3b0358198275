"""The key that signs operators' commands to a site's robots, as a file."""

from pathlib import Path

from fog_contracts.commands import KEY_BYTES


class OperatorKeyError(ValueError):
    """A file is no operators' key; the message names the file and the remedy."""


def read_operator_key(file: Path) -> bytes:
    """Return the key that signs commands to robots from a file with its hexadecimal digits (`operator.key`).

    Raises `OperatorKeyError`.
    """
    remedy = f"Write {2 * KEY_BYTES} or more hexadecimal digits into it (openssl rand -hex {KEY_BYTES})"
    try:
        key = bytes.fromhex(file.read_text("ascii").strip())
    except OSError as error:
        raise OperatorKeyError(f"the operators' key {file} can't be read: {error.strerror}. {remedy}") from error
    except ValueError as error:
        raise OperatorKeyError(f"the operators' key {file} is not hexadecimal. {remedy}") from error
    if len(key) < KEY_BYTES:
        raise OperatorKeyError(f"the operators' key {file} is only {len(key)} bytes long. {remedy}")
    return key
