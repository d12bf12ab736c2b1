# SPDX-License-Identifier: Apache-2.0
"""A server goes on with its certificate, whatever half of the next one is there already."""

import ssl
from pathlib import Path
from typing import Any

import pytest

from shared.tls_server import load_certificate
from tests.unit.services.dashboard.credentials import certificate_and_key, make_credentials


class RenewedMeanwhile(ssl.SSLContext):
    """A server's context. Just before it reads its certificate, the first half of the next one is written."""

    file: Path
    following: bytes = b""

    def load_cert_chain(self, certfile: Any, keyfile: Any = None, password: Any = None) -> None:
        if self.following:
            self.file.write_bytes(self.following)
        super().load_cert_chain(certfile, keyfile, password)


def shown(context: ssl.SSLContext) -> bytes:
    """The certificate that a client gets in a handshake, DER. Raises SSLError where the context has no key."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    trusting = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE
    server = context.wrap_bio(to_server, to_client, server_side=True)
    client = trusting.wrap_bio(to_client, to_server)
    waiting = [client, server]
    while waiting:
        end = waiting.pop(0)
        try:
            end.do_handshake()
        except ssl.SSLWantReadError:
            waiting.append(end)
    return client.getpeercert(binary_form=True) or b""


@pytest.mark.parametrize("is_written_meanwhile", [False, True])
def test_half_of_the_next_certificate_leaves_the_present_one_in_use(tmp_path, is_written_meanwhile):
    secure = make_credentials(tmp_path)
    files = secure.robot_certificate, secure.robot_key
    present, (following, _) = ssl.PEM_cert_to_DER_cert(files[0].read_text()), certificate_and_key(20.5)
    context = RenewedMeanwhile(ssl.PROTOCOL_TLS_SERVER)
    load_certificate(context, *files)
    assert shown(context) == present
    if is_written_meanwhile:
        context.file, context.following = files[0], following
        load_certificate(context, *files)
    else:
        files[0].write_bytes(following)
    assert shown(context) == present
    context.following = b""
    with pytest.raises(ssl.SSLError):
        load_certificate(context, *files)
    assert shown(context) == present


def test_a_file_that_is_missing_is_the_one_that_the_error_names(tmp_path):
    secure = make_credentials(tmp_path)
    with pytest.raises(FileNotFoundError) as error:
        load_certificate(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), secure.robot_certificate, tmp_path / "none")
    assert error.value.filename == str(tmp_path / "none")
