# SPDX-License-Identifier: Apache-2.0
"""The gate before the Foxglove servers: its certificate, and members that lose their access."""

import socket
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

import pytest

from shared.secure_folder import MemberRole, SecureFolder
from zenav.foxglove.gate import Gate, GateCredentials
from zenav.secure import members
from zenav.secure.authority import Authority, Issued
from zenav.secure.tokens import issue_token

LIMIT_S = 10.0


@pytest.fixture
def place(tmp_path) -> SecureFolder:
    place = SecureFolder(tmp_path / "secure")
    members.init_folder("x80sv", str(place.path), ["127.0.0.1"])
    return place


class Said:
    """The lines of a gate."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._changed = threading.Condition()

    def say(self, text: str, trouble: bool) -> None:
        with self._changed:
            self.lines.append(text)
            self._changed.notify_all()

    def wait(self, words: str) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: any(words in line for line in self.lines), LIMIT_S), self.lines


@contextmanager
def gate(place: SecureFolder, said: Said) -> Iterator[int]:
    """An open gate before a server that accepts, and says nothing; its port."""
    with socket.create_server(("127.0.0.1", 0)) as backend:
        port = backend.getsockname()[1]
        credentials = GateCredentials(place, place.robot_certificate, place.robot_key)
        opened = Gate(credentials, (port, port), said.say)
        try:
            yield opened.open("127.0.0.1", 0)
        finally:
            opened.close()


@contextmanager
def connected(place: SecureFolder, port: int, token: str = "") -> Iterator[ssl.SSLSocket]:
    context = ssl.create_default_context(cafile=place.authority_certificate)
    with (
        socket.create_connection(("127.0.0.1", port), LIMIT_S) as raw,
        context.wrap_socket(raw, server_hostname="127.0.0.1") as connection,
    ):
        if token:
            connection.sendall(f"GET /?token={token} HTTP/1.1\r\n\r\n".encode())
        yield connection


def shown(place: SecureFolder, port: int) -> str:
    """The certificate that a new connection gets, PEM."""
    with connected(place, port) as connection:
        return ssl.DER_cert_to_PEM_cert(connection.getpeercert(binary_form=True) or b"").strip()


def renewed(place: SecureFolder) -> Issued:
    return Authority(place).robot(["127.0.0.1"], members.today() + timedelta(days=10))


def test_the_former_certificate_is_shown_until_the_key_of_the_new_one_is_there(place):
    said, before, new = Said(), place.robot_certificate.read_text().strip(), renewed(place)
    with gate(place, said) as port:
        assert shown(place, port) == before
        place.write(place.robot_certificate, new.certificate)
        said.wait("give a certificate and its key")
        assert shown(place, port) == before
        place.write(place.robot_key, new.key)
        limit = threading.Event()
        for _ in range(100):
            if shown(place, port) == new.certificate.decode().strip():
                break
            limit.wait(0.1)
        assert shown(place, port) == new.certificate.decode().strip()


@pytest.mark.parametrize("damage", ["a folder in its place", "a member without a date"])
def test_a_list_of_members_that_cannot_be_read_ends_connections_until_it_can(place, tmp_path, capsys, damage):
    members.add_member("otto", MemberRole.OPERATOR, str(place.path), tmp_path / "otto.pem", 10)
    capsys.readouterr()
    issue_token("otto", str(place.path))
    token, said, whole = capsys.readouterr().out.strip(), Said(), place.members_file.read_bytes()
    with gate(place, said) as port:
        with connected(place, port, token) as connection:
            said.wait("otto (operator) connected")
            place.members_file.unlink()
            if damage == "a folder in its place":
                place.members_file.mkdir()
            else:
                place.members_file.write_bytes(whole.replace(b'"20', b'"the year 20'))
            assert connection.recv(1) == b""
        if place.members_file.is_dir():
            place.members_file.rmdir()
        place.write(place.members_file, whole)
        said.lines.clear()
        with connected(place, port, token) as connection:
            said.wait("otto (operator) connected")
            members.revoke_member("otto", str(place.path))
            assert connection.recv(1) == b""
