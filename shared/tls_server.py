# SPDX-License-Identifier: Apache-2.0
"""The certificate of a server that runs: another one for new connections, without a restart."""

import ssl
from pathlib import Path
from tempfile import TemporaryDirectory


def load_certificate(context: ssl.SSLContext, certificate: Path, key: Path) -> None:
    """Shows a certificate to new connections. certificate, key: PEM, the key without a passphrase.

    Raises OSError (SSLError is one) where the two cannot be used. The context then shows the former certificate.
    """
    # OpenSSL drops the former key before it compares the new one, and reads files alone. So a trial comes first, and
    # both read the same copies, in a folder for this user alone: one of the files may be renewed between them
    with TemporaryDirectory() as folder:
        copies = Path(folder) / "certificate", Path(folder) / "key"
        for source, copy in zip((certificate, key), copies):
            copy.write_bytes(source.read_bytes())
        for target in (ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), context):
            target.load_cert_chain(*copies, password="")  # else OpenSSL asks for a passphrase at the terminal
