"""How a process proves who it is, and whom it trusts: its credentials, and the certificate of a REST API.

    user = "map-service"
    authority = '''-----BEGIN CERTIFICATE-----...'''   # the certificate authorities that its servers may have
    token = "..."                                       # of the REST APIs; only where it calls them
    [passwords]                                         # one for each server, which so learns no other's
    mqtt = "..."
    zenoh = "..."
    redis = "..."

The scheme of an address decides whether its connection is encrypted (`mqtts:`, `tls/`, `rediss:`, `https:`). Over one
that is not, a password is sent within this computer only.
"""

from __future__ import annotations

import ipaddress
import tomllib
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, Self

import msgspec

if TYPE_CHECKING:
    import ssl
    from pathlib import Path

Server = Literal["mqtt", "zenoh", "redis"]
SERVERS: Final[tuple[Server, ...]] = ("mqtt", "zenoh", "redis")
VARIABLE: Final = "FOGNAV_CREDENTIALS_FILE"
_REMEDY: Final = "Copy it from the fog node again (fognav ca, node add, robot add and token create write such files)"


class CredentialsError(ValueError):
    """A file has no credentials, or a connection would reveal them; the message names the file and the remedy."""


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    user: str
    authority: str = ""
    token: str = ""
    passwords: dict[Server, str] = {}


class Credentials:
    """The user, passwords and trusted authorities of one file, which no log shows."""

    def __init__(
        self, user: str = "", *, passwords: dict[Server, str] | None = None, authority: str = "", token: str = "",
        file: Path | None = None, readable: bool = False,
    ) -> None:  # fmt: skip
        """Take over values; `authority` are certificates (PEM), without any those that the operating system trusts.

        `readable`: passwords may leave this computer unencrypted, since somebody has said so.
        Raises `CredentialsError` for certificates that can't be used.
        """
        self.user = user
        self.authority = authority
        self.token = token
        self.passwords = passwords or {}
        self._file = file
        self._readable = readable
        if authority:
            self.tls_context()

    @classmethod
    def read(cls, file: Path | None, *, readable: bool = False) -> Self:
        """Return the credentials in a file; without one, those of nobody. Raises `CredentialsError`."""
        if file is None:
            return cls()
        try:
            found = msgspec.convert(tomllib.loads(file.read_text("utf-8")), _File)
        except OSError as error:
            raise CredentialsError(
                f"the credentials {file} can't be read: {error.strerror}. {_REMEDY}, or correct {VARIABLE}"
            ) from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise CredentialsError(f"the credentials {file} are not valid TOML: {error}. {_REMEDY}") from error
        except msgspec.ValidationError as error:
            raise CredentialsError(f"the credentials {file}: {error}. {_REMEDY}") from error
        return cls(
            found.user, passwords=found.passwords, authority=found.authority, token=found.token, file=file,
            readable=readable,
        )  # fmt: skip

    @property
    def origin(self) -> str:
        """Where they come from, for messages."""
        return str(self._file) if self._file is not None else f"no credentials ({VARIABLE} is not set)"

    def tls_context(self) -> ssl.SSLContext:
        """Return what a connection needs that is encrypted, and whose server proves its name.

        Raises `CredentialsError` for certificates that can't be used.
        """
        import ssl  # noqa: PLC0415  # the guardian reads settings, too, and never needs it

        try:
            return ssl.create_default_context(cadata=self.authority or None)
        except (ssl.SSLError, ValueError) as error:
            raise CredentialsError(
                f"the certificates (authority) in {self.origin} can't be used: {error}. {_REMEDY}"
            ) from error

    def login(self, server: Server, address: str, host: str, *, encrypted: bool) -> tuple[str, str] | None:
        """Return user and password for a server; None without a password for it.

        Raises `CredentialsError` if the password would leave this computer unencrypted.
        """
        password = self.passwords.get(server)
        if password is None:
            return None
        if not encrypted and not self._readable and not _is_this_computer(host):
            raise CredentialsError(
                f"{address} is not encrypted, so everybody in the network could read the password in {self.origin}. "
                f"Use {_ENCRYPTED[server]}"
            )
        return self.user, password


_ENCRYPTED: Final[dict[Server, str]] = {
    "mqtt": "mqtts://HOST:8883",
    "zenoh": "tls/HOST:7447",
    "redis": "rediss://HOST:6379/0",
}

NOBODY: Final = Credentials()
"""Of a process that proves nothing: for servers that admit everybody."""


def _is_this_computer(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def to_toml(user: str, *, authority: str, passwords: dict[Server, str], token: str = "") -> str:
    """Return the text of a credentials file."""
    lines = [
        "# Credentials for Fognav: whoever has this file can act in this name. Keep it private.",
        f"user = {_quoted(user)}",
    ]
    if token:
        lines.append(f"token = {_quoted(token)}")
    lines += [f"authority = '''\n{authority}'''"]
    if passwords:
        lines += ["[passwords]", *(f"{server} = {_quoted(password)}" for server, password in passwords.items())]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    """Return a TOML string; escapes of JSON are escapes of TOML."""
    return msgspec.json.encode(text).decode()


class CertificateError(ValueError):
    """A certificate or its key can't be used; the message names the files and the remedy."""


class ServerCertificate(NamedTuple):
    """The files of a certificate, with those between it and its authority, and of its private key (both PEM)."""

    file: Path
    key: Path

    @classmethod
    def of(cls, file: Path | None, key: Path | None) -> Self | None:
        """Return what two settings name, checked; None without either. Raises `CertificateError`."""
        if file is None and key is None:
            return None
        if file is None or key is None:
            raise CertificateError("FOGNAV_HTTP_CERTIFICATE_FILE and FOGNAV_HTTP_KEY_FILE belong together: set both")
        import ssl  # noqa: PLC0415  # the guardian reads settings, too, and never needs it

        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(file, key)
        except OSError as error:
            raise CertificateError(
                f"the certificate {file} with the key {key} can't be used: {error.strerror or error}. "
                "Issue it again (fognav ca issue), or correct the names"
            ) from error
        return cls(file, key)
