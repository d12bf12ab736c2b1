# SPDX-License-Identifier: Apache-2.0
"""The certificate of a server that runs: another one for new connections, without a restart."""

import ssl
from pathlib import Path


def load_certificate(context: ssl.SSLContext, certificate: Path, key: Path) -> None:
    """Shows a certificate to new connections. certificate, key: PEM, the key without a passphrase.

    Raises OSError (SSLError is one) where the two cannot be used. The context then shows the former certificate.
    """
    trial = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)  # OpenSSL drops the former key before it compares the new one
    for target in (trial, context):
        target.load_cert_chain(certificate, key, password="")  # else OpenSSL asks for a passphrase at the terminal
