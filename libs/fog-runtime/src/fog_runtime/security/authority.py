"""A certificate authority of the site's own, whose certificates prove the names of its servers.

Clients have its certificate in their credentials and trust no other authority. It can be replaced while everything
runs (`rotate`): the new authority is certified by the old one, and that certificate goes with each new server's. So
clients that know only the old authority accept the new servers' certificates, as do those that know only the new one,
in whichever order servers and clients are renewed. `finish` ends the overlap.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fog_runtime.files import PRIVATE, atomic_write

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

AUTHORITY_DAYS: Final = 3650
SERVER_DAYS: Final = 730
_VALID_FROM: Final = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
"""A computer without a battery for its clock may start there, and would trust nobody before its clock is set."""
_END_OF_KEY: Final = b"-----END PRIVATE KEY-----\n"


class AuthorityError(ValueError):
    """A certificate authority can't be created, read or used so; the message names the file and the remedy."""


@dataclass(frozen=True)
class Issued:
    """A server's certificate, followed by those between it and the authorities, and its private key (both PEM)."""

    chain: bytes
    key: bytes


class Authority:
    """A certificate authority in one file, private to its owner: key, certificate, and those of a rotation."""

    def __init__(
        self, file: Path, key: ec.EllipticCurvePrivateKey, current: x509.Certificate, *rotation: x509.Certificate
    ) -> None:
        """Use `create` or `open`; `rotation`: the new authority as the old one certified it, and the old authority."""
        self._file = file
        self._key = key
        self._current = current
        self._rotation = rotation

    @classmethod
    def create(cls, file: Path, name: str, *, now: dt.datetime) -> Self:
        """Create an authority with a name for people; raises `AuthorityError` if the file exists."""
        if file.exists():
            raise AuthorityError(f"{file} has a certificate authority already: rotate it, or name another file")
        key = ec.generate_private_key(ec.SECP256R1())
        authority = cls(file, key, _authority(name, key, None, now))
        authority._store()
        return authority

    @classmethod
    def open(cls, file: Path) -> Self:
        """Open an authority; raises `AuthorityError`."""
        try:
            key_text, end, certificates = file.read_bytes().partition(_END_OF_KEY)
            key = load_pem_private_key(key_text + end, None)
            current, *rotation = x509.load_pem_x509_certificates(certificates)
        except OSError as error:
            raise AuthorityError(
                f"the certificate authority {file} can't be read: {error.strerror}. Create it (fognav ca create), or "
                "restore it from a backup"
            ) from error
        except ValueError as error:
            raise AuthorityError(f"{file} is no certificate authority: {error}. Restore it from a backup") from error
        if not isinstance(key, ec.EllipticCurvePrivateKey) or len(rotation) not in (0, 2):
            raise AuthorityError(f"{file} was not written by Fognav. Restore it from a backup")
        return cls(file, key, current, *rotation)

    @property
    def trusted(self) -> str:
        """What clients shall trust (PEM): this authority and, while it is being replaced, the one before."""
        return "".join(_pem(each).decode() for each in self._roots)

    @property
    def rotating(self) -> bool:
        """Whether the authority before is still trusted."""
        return bool(self._rotation)

    @property
    def expires(self) -> dt.datetime:
        """When the first of the trusted authorities expires."""
        return min(each.not_valid_after_utc for each in self._roots)

    def lasts_until(self, now: dt.datetime) -> dt.datetime:
        """Return until when a certificate would be valid that is issued now."""
        return min(now + dt.timedelta(days=SERVER_DAYS), self._current.not_valid_after_utc)

    def issue(self, name: str, hosts: Sequence[str], *, now: dt.datetime, days: int = SERVER_DAYS) -> Issued:
        """Certify a new key of the server `name`, for the names and addresses by which clients reach it.

        Raises `AuthorityError` without any.
        """
        if not hosts:
            raise AuthorityError(f"the server {name} needs a host name or address by which clients reach it")
        key = ec.generate_private_key(ec.SECP256R1())
        names = x509.SubjectAlternativeName([_host(host) for host in hosts])
        builder = (
            _builder(name, self._current.subject, key, self._current, now, days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
            .add_extension(_usage(certify=False), critical=True)
            .add_extension(names, critical=False)
        )
        certificate = builder.sign(self._key, SHA256())
        return Issued(_pem(certificate) + b"".join(_pem(each) for each in self._rotation[:1]), _key_pem(key))

    def rotate(self, *, now: dt.datetime) -> None:
        """Replace the authority by a new one that those accept who trust the present one.

        Raises `AuthorityError` while the rotation before is not finished: who trusts only the one before that would
        accept neither.
        """
        if self._rotation:
            raise AuthorityError(f"{self._file}: the rotation before is not finished. Finish it first (--finish)")
        old, old_key = self._current, self._key
        self._key = ec.generate_private_key(ec.SECP256R1())
        # A name of its own, by which the new one is never mistaken for the old one.
        name = f"{_common_name(old).partition(' since ')[0]} since {now:%Y-%m-%d %H:%M:%S}"
        self._current = _authority(name, self._key, None, now)
        self._rotation = (_authority(name, self._key, (old, old_key), now), old)
        self._store()

    def finish(self) -> None:
        """End the rotation: from now on only the new authority is trusted. Raises `AuthorityError` without one."""
        if not self._rotation:
            raise AuthorityError(f"{self._file} is not being rotated: there is nothing to finish")
        self._rotation = ()
        self._store()

    @property
    def _roots(self) -> list[x509.Certificate]:
        return [self._current, *self._rotation[1:]]

    def _store(self) -> None:
        """Write the file, in one step: whatever is cut short leaves the authority as it was."""
        certificates = b"".join(_pem(each) for each in (self._current, *self._rotation))
        atomic_write(self._file, _key_pem(self._key) + certificates, mode=PRIVATE)


def expiry(chain: Path) -> dt.datetime:
    """Return when a server's certificate expires; raises `AuthorityError`."""
    try:
        return x509.load_pem_x509_certificates(chain.read_bytes())[0].not_valid_after_utc
    except OSError as error:
        raise AuthorityError(f"the certificate {chain} can't be read: {error.strerror}. Issue it again") from error
    except ValueError as error:
        raise AuthorityError(f"{chain} is no certificate: {error}. Issue it again (fognav ca issue)") from error


def _builder(
    name: str,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    parent: x509.Certificate | None,
    now: dt.datetime,
    days: int,
) -> x509.CertificateBuilder:
    end = now + dt.timedelta(days=days)
    if parent is not None:
        end = min(end, parent.not_valid_after_utc)
    issuer_key = key.public_key() if parent is None else parent.public_key()
    identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key)  # type: ignore[arg-type]  # cryptography types the keys of any kind
    return (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(_VALID_FROM)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(identifier, critical=False)
    )


def _authority(
    name: str,
    key: ec.EllipticCurvePrivateKey,
    by: tuple[x509.Certificate, ec.EllipticCurvePrivateKey] | None,
    now: dt.datetime,
) -> x509.Certificate:
    """Certify an authority: by itself, or by another one."""
    parent, signing = by or (None, key)
    issuer = _name(name) if parent is None else parent.subject
    return (
        _builder(name, issuer, key, parent, now, AUTHORITY_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .add_extension(_usage(certify=True), critical=True)
        .sign(signing, SHA256())
    )


def _usage(*, certify: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not certify, key_cert_sign=certify, crl_sign=certify, content_commitment=False,
        key_encipherment=False, data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _common_name(certificate: x509.Certificate) -> str:
    return str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
