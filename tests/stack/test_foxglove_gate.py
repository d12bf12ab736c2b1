# SPDX-License-Identifier: Apache-2.0
"""The Foxglove server on a network: TLS, a token for each client, and a viewer that only looks."""

import socket
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from websockets.exceptions import InvalidMessage, InvalidStatus

from shared.runners.transport import StackAddress
from shared.secure_folder import MemberRole, SecureFolder
from tests.stack.foxglove_app import SUBPROTOCOL, FakeApp, twist
from tests.stack.test_client import StopGuard
from tests.stack.test_live import ROBOT, running
from tests.websocket import WebSocketClient
from zenav.__main__ import _status
from zenav.client import Client
from zenav.console.shutdown import StopFlag
from zenav.foxglove.gate import MAX_HEAD
from zenav.foxglove.server import gate_credentials, live_view
from zenav.secure import members
from zenav.secure.tokens import issue_token
from zenav.stack.launch import free_stack


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> SecureFolder:
    place = SecureFolder(tmp_path_factory.mktemp("foxglove") / "secure")
    members.init_folder("x80sv", str(place.path), [])
    return place


@pytest.fixture
def tls(place) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=place.authority_certificate)


@pytest.fixture(scope="module")
def where() -> Iterator[StackAddress]:
    with free_stack() as claim:
        yield claim.where


@pytest.fixture
def port(place, where, monkeypatch) -> Iterator[int]:
    monkeypatch.setenv("ZENAV_SECURE", str(place.path))
    with served(where, place) as port:
        yield port


@contextmanager
def served(where: StackAddress, place: SecureFolder) -> Iterator[int]:
    """A live view on loopback with the certificate that it would have on a network; its port."""
    stop = StopFlag()
    credentials = gate_credentials("127.0.0.1", place.robot_certificate, place.robot_key)
    with Client(ROBOT.name, where) as client, live_view(client, ROBOT, "127.0.0.1", 0, credentials) as view:
        thread = threading.Thread(target=view.run, args=(stop,))
        thread.start()
        try:
            yield view.port
        finally:
            stop.set()
            thread.join(10)


def ended(connection: socket.socket) -> bool:
    """Whether the other side ends a connection without an answer."""
    try:
        return connection.recv(1) == b""
    except ConnectionError:
        return True


def new_token(place: SecureFolder, name: str, role: MemberRole, capsys) -> str:
    out: Path = place.path.parent / f"{name}.{len(place.members())}.pem"
    members.add_member(name, role, str(place.path), out, 10)
    capsys.readouterr()
    issue_token(name, str(place.path))
    return capsys.readouterr().out.strip()


def test_a_viewer_sees_and_cannot_drive_and_an_operator_can(place, tls, where, port, capsys):
    viewer = new_token(place, "vera", MemberRole.VIEWER, capsys)
    operator = new_token(place, "otto", MemberRole.OPERATOR, capsys)
    guard = StopGuard()
    with running(guard, "guard", where), FakeApp(port, viewer, tls) as looks, FakeApp(port, operator, tls) as drives:
        looks.subscribe("/guard/status")
        looks.until(lambda: looks.last("/guard/status"))
        looks.announce("/teleop", "geometry_msgs/Twist")
        looks.publish("/teleop", twist(0.3, 0.0))
        looks.until(lambda: looks.told("does not support clientPublish"))
        assert "failure" in looks.call("/estop")
        assert not looks.services
        assert not guard.driven
        assert drives.call("/estop") == {"success": True, "message": "STOP is pressed"}
        drives.announce("/teleop", "geometry_msgs/Twist")
        drives.until(
            lambda: (0.2, 0.0) in guard.driven,
            meanwhile=lambda: drives.publish("/teleop", twist(0.2, 0.0)),
        )
    said = capsys.readouterr().err
    assert "otto (operator) connected from 127.0.0.1" in said
    assert "vera (viewer) disconnected" in said
    assert viewer not in said
    assert operator not in said
    kept = place.tokens_file.read_text()
    assert viewer not in kept
    assert operator not in kept
    assert place.tokens_file.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("path", ["", "/", "/?token=", "/?token=wrong", "/?token=" + "x" * 5000, "/?other=1"])
def test_a_client_without_a_valid_token_is_refused_and_said(tls, port, path, capsys):
    with pytest.raises(InvalidStatus, match="401"), WebSocketClient(f"wss://127.0.0.1:{port}{path}", ssl=tls):
        pass
    assert "refused a connection from 127.0.0.1: no valid token" in capsys.readouterr().err


def test_plain_connections_and_heads_without_an_end_are_cut(place, tls, port, capsys):
    with pytest.raises((InvalidMessage, OSError, EOFError)), WebSocketClient(f"ws://127.0.0.1:{port}"):
        pass
    foreign = ssl.create_default_context()  # trusts other authorities
    with pytest.raises(ssl.SSLCertVerificationError), WebSocketClient(f"wss://127.0.0.1:{port}", ssl=foreign):
        pass
    with socket.create_connection(("127.0.0.1", port)) as raw, tls.wrap_socket(raw, server_hostname="127.0.0.1") as it:
        it.settimeout(10)
        it.sendall(b"GET / HTTP/1.1\r\nX: " + b"x" * MAX_HEAD)
        assert ended(it)
    with FakeApp(port, new_token(place, "after", MemberRole.VIEWER, capsys), tls):
        pass


def test_a_token_ends_at_once_when_its_member_is_revoked_or_has_a_new_one(place, tls, port, capsys):
    old = new_token(place, "rita", MemberRole.OPERATOR, capsys)
    with FakeApp(port, old, tls) as app:
        issue_token("rita", str(place.path))
        new = capsys.readouterr().out.strip()
        with pytest.raises(AssertionError, match="closed the connection"):
            app.until(lambda: False, 30)
    with FakeApp(port, new, tls) as app:
        members.revoke_member("rita", str(place.path))
        with pytest.raises(AssertionError, match="closed the connection"):
            app.until(lambda: False, 30)
    for token in (old, new):
        with (
            pytest.raises(InvalidStatus, match="401"),
            WebSocketClient(f"wss://127.0.0.1:{port}/?token={token}", ssl=tls, subprotocols=[SUBPROTOCOL]),
        ):
            pass


def test_an_address_of_a_network_is_refused_without_certificates(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path / "none"))
    for host in ("0.0.0.0", "192.168.7.7", "robot.local", "::"):
        assert _status(["foxglove", "--host", host, "--port", "0"]) == 2
        assert capsys.readouterr().err.splitlines() == [
            f"there are no certificates in {tmp_path / 'none'}",
            "hint: make them: zenav secure init",
        ]


def test_a_certificate_without_its_key_or_with_another_ones_is_an_error_of_one_line(place, where, monkeypatch, capsys):
    monkeypatch.setenv("ZENAV_SECURE", str(place.path))
    assert _status(["foxglove", "--cert", str(place.robot_certificate)]) == 2
    assert "a certificate and its key belong together" in capsys.readouterr().err
    wrong = ["--cert", str(place.robot_certificate), "--key", str(place.authority_key), "--port", "0"]
    assert _status(["foxglove", *wrong, "--stack", str(where.domain)]) == 2
    assert "hint: give a certificate and its key as PEM" in capsys.readouterr().err


def test_a_service_has_no_token(place, capsys):
    members.add_member("mapper", MemberRole.SERVICE, str(place.path), place.path.parent / "mapper.pem", 10)
    assert _status(["secure", "token", "mapper", "--dir", str(place.path)]) == 2
    assert "mapper is a service" in capsys.readouterr().err
    assert _status(["secure", "token", "nemo", "--dir", str(place.path)]) == 2
    assert "nemo is no member" in capsys.readouterr().err
