"""The certificate with which a REST API proves its name, for HTTPS."""

from pathlib import Path
from typing import NamedTuple, Self


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
