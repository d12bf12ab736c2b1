# SPDX-License-Identifier: Apache-2.0
"""The certificate that the page shows to browsers: its names, its end, and TLS with it."""

import ssl
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from shared.config import UserError
from shared.tls_server import load_certificate

if TYPE_CHECKING:
    from cryptography.x509 import Certificate


@dataclass(frozen=True, slots=True)
class PageCertificate:
    """names: DNS names and IP addresses of its subject, in its order.  until: its end, s since 1970."""

    certificate: Path
    key: Path
    names: tuple[str, ...]
    until: float

    def context(self) -> ssl.SSLContext:
        """TLS 1.2 and newer. Raises UserError as `load_into` does."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        self.load_into(context)
        return context

    def load_into(self, context: ssl.SSLContext) -> None:
        """Shows this certificate to new connections.

        Raises UserError where certificate and key do not fit. The context then shows the former ones.
        """
        try:
            load_certificate(context, self.certificate, self.key)
        except OSError as error:  # SSLError is one
            raise UserError(
                f"{self.certificate} and {self.key}: {error.strerror or error}", "name a certificate and its key"
            ) from None


def read_certificate(certificate: Path, key: Path) -> PageCertificate:
    """The first certificate of a PEM file. Raises UserError."""
    from cryptography import x509  # loaded only where the page has a certificate

    parsed = _parsed(certificate)
    try:
        names = parsed.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        dns = names.get_values_for_type(x509.DNSName)
        addresses = [str(address) for address in names.get_values_for_type(x509.IPAddress)]
    except (x509.ExtensionNotFound, ValueError):
        dns, addresses = [], []
    until: datetime = parsed.not_valid_after_utc
    return PageCertificate(certificate, key, (*(name.lower() for name in dns), *addresses), until.timestamp())


def _parsed(file: Path) -> "Certificate":
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificate(file.read_bytes())
    except OSError as error:
        raise UserError(f"{file}: {error.strerror}", "name a certificate: dashboard.certificate") from None
    except ValueError:
        raise UserError(f"{file} is no certificate in PEM", "make one: zenav secure init") from None
