# SPDX-License-Identifier: Apache-2.0
"""The page for other computers, over real HTTPS: what is refused without a session, and what each role may do."""

import http.client
import socket
import ssl
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from services.dashboard import page_hub
from services.dashboard.login_store import LoginStore
from services.dashboard.login_throttle import FREE_FAILURES
from services.dashboard.web_guard import COOKIE, cookie_of
from services.dashboard.web_login import MAX_BODY
from shared.messages import Velocity
from shared.ports import PortConfig
from shared.roles import Role
from shared.secure_folder import secure_folder
from tests.unit.services.dashboard.browser import SOON, Browser, Served, serving
from tests.unit.services.dashboard.credentials import REMOTE, make_credentials
from tests.unit.services.dashboard.remote import RemoteComputer, invitation, logged_in, serving_remote


@pytest.fixture
def served(monkeypatch, tmp_path: Path) -> Iterator[Served]:
    with serving_remote(monkeypatch, tmp_path / "secure") as server:
        yield server


@pytest.fixture
def stranger(served) -> RemoteComputer:
    return RemoteComputer(served.port)


def refused_page(computer: RemoteComputer, **options) -> int:
    """The status with which a page is refused before its WebSocket is accepted."""
    with pytest.raises(InvalidStatus) as refused:
        computer.page(read=False, **options)
    return refused.value.response.status_code


# --- TLS --------------------------------------------------------------------------------------------------------------


def test_the_port_for_other_computers_speaks_tls_only(served):
    plain = http.client.HTTPConnection(REMOTE, served.port, timeout=SOON)
    with closing(plain):
        plain.request("GET", "/")
        with pytest.raises((http.client.BadStatusLine, ConnectionError)):
            plain.getresponse()
    assert RemoteComputer(served.port).request("GET", "/")[0] == 200


def test_tls_before_1_2_is_refused(served):
    old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    old.check_hostname, old.verify_mode = False, ssl.CERT_NONE
    with pytest.warns(DeprecationWarning, match="TLSv1_1"):
        old.maximum_version = ssl.TLSVersion.TLSv1_1
    with closing(socket.create_connection((REMOTE, served.port), SOON)) as sock, pytest.raises((ssl.SSLError, OSError)):
        old.wrap_socket(sock)


def test_a_handshake_that_never_ends_is_disconnected(monkeypatch, tmp_path):
    monkeypatch.setattr("services.dashboard.web_server.HANDSHAKE_LIMIT_S", 0.2)
    with serving_remote(monkeypatch, tmp_path) as served:
        with closing(socket.create_connection((REMOTE, served.port), SOON)) as slow, suppress(ConnectionResetError):
            assert slow.recv(100) == b""
        assert RemoteComputer(served.port).request("GET", "/")[0] == 200


def test_on_loopback_without_a_named_certificate_the_page_stays_plain_http_without_a_login(monkeypatch, tmp_path):
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path))
    make_credentials(tmp_path)
    with serving(monkeypatch) as served, Browser(served.port) as page:
        hello = page.first("hello")
        assert (hello["role"], hello["login"]) == ("admin", False)
        assert served.request("GET", "/session")[0] == 200


def test_one_computer_cannot_take_all_connections(served, monkeypatch):
    monkeypatch.setattr("services.dashboard.web_server.MAX_OF_ADDRESS", 3)
    computer, friend = logged_in(served, Role.VIEWER), logged_in(served, Role.OPERATOR, "ben")
    friend.address = "127.0.0.3"
    pages = [computer.page() for _ in range(3)]
    try:
        for page in pages:
            page.first("hello")
        with pytest.raises((WebSocketException, OSError)):
            computer.page(read=False)
        with friend.page() as page:
            page.first("hello")
    finally:
        for page in pages:
            page.socket.close()


# --- without a session ------------------------------------------------------------------------------------------------


def test_without_a_session_there_is_the_login_page_and_nothing_else(served, stranger):
    for path, status in (("/", 200), ("/static/app.js", 200), ("/session", 401)):
        assert stranger.request("GET", path)[0] == status
    for path in ("/maps/office.zip", "/recordings/a.mcap", "/ws", "/maps", "/static", "//", "/logout", "/Session"):
        assert stranger.request("GET", path)[0] == 401, path
    for path in ("/maps?name=office", "/logout", "/", "/static/app.js", "/session"):
        assert stranger.request("POST", path, b"x")[0] == 401, path
    assert refused_page(stranger) == 401
    assert served.links[0].is_open is False, "no session on the stack for a stranger"


@pytest.mark.parametrize(
    "cookie", ["", "x", "a" * 5000, "\x00", '"', f"x; {COOKIE}=y", "é", "0" * 43, "../../sessions.json"]
)
def test_a_cookie_that_is_no_session_opens_nothing(served, stranger, cookie):
    LoginStore(secure_folder()).redeem(invitation())
    given = {"cookie": f"{COOKIE}={cookie}"} if cookie.isprintable() and cookie.isascii() else {}
    assert stranger.request("GET", "/session", **given)[0] == 401
    assert refused_page(stranger, headers=given) == 401


@pytest.mark.parametrize("other", ["a=1", 'prefs={"theme":"dark"}', "title=a b", "name=J\xf6rg", "="])
def test_a_cookie_of_another_program_on_the_host_is_in_no_way(other):
    assert cookie_of({b"cookie": f"{other}; {COOKIE}=token".encode("latin-1")}) == "token"


def test_the_hash_on_disk_opens_nothing(served, stranger):
    opened = LoginStore(secure_folder()).redeem(invitation())
    assert opened is not None
    stranger.cookie = opened[1].digest
    assert stranger.request("GET", "/session")[0] == 401


# --- login ------------------------------------------------------------------------------------------------------------


def test_an_invitation_logs_in_once_and_the_page_has_its_name_and_role(served):
    token = invitation(Role.VIEWER, "ben")
    computer, second = RemoteComputer(served.port), RemoteComputer(served.port)
    assert computer.login(token) == 200
    assert second.login(token) == 401
    assert computer.cookie_line.lower() == (
        f"{COOKIE}={computer.cookie}; httponly; max-age=2592000; path=/; samesite=strict; secure".lower()
    )
    assert '"ben"' in computer.request("GET", "/session")[1]
    with computer.page() as page:
        hello = page.first("hello")
        assert (hello["name"], hello["role"], hello["login"]) == ("ben", "viewer", True)
        assert page.first("clients")["clients"] == [{"client": 1, "name": "ben", "role": "viewer"}]
        page.send("name", name="admin")
        assert "name is that of the login" in page.first("note")["text"]
    assert ("INFO", f"audit: ben (viewer, {REMOTE}): login") in served.logs


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": ""},
        {"origin": "https://evil.example"},
        {"origin": "null"},
        {"origin": f"http://{REMOTE}:8600"},
        {"content_type": ""},
        {"content_type": "text/plain"},
        {"content_type": "application/x-www-form-urlencoded"},
    ],
)
def test_a_login_that_another_page_could_send_is_refused_and_leaves_the_invitation(served, stranger, headers):
    token = invitation()
    assert stranger.login(token, **headers) == 403
    assert stranger.login(token) == 200


def test_a_token_in_the_path_is_no_login(served, stranger):
    token = invitation()
    for method, path in (("GET", f"/login?token={token}"), ("GET", f"/?invite={token}"), ("POST", f"/login?{token}")):
        stranger.request(method, path, b"" if method == "POST" else None, content_type="application/json")
        assert stranger.cookie == ""


@pytest.mark.parametrize(
    "body", [b"", b"{", b"[]", b"7", b'{"token": 7}', b'{"token": ""}', b"[" * 900, b'{"token": "' + b"x" * 200 + b'"}']
)
def test_a_body_that_is_no_token_is_a_failed_login(served, stranger, body):
    assert stranger.request("POST", "/login", body, content_type="application/json")[0] == 401


def test_a_body_over_the_limit_is_a_failed_login(served, stranger):
    token = invitation()
    body = b'{"token": "' + token.encode() + b'"' + b" " * MAX_BODY + b"}"
    assert stranger.request("POST", "/login", body, content_type="application/json")[0] == 401
    assert stranger.login(token) == 200


def test_failed_logins_are_slowed_counted_and_reported_and_a_session_goes_on(served, stranger):
    token, friend = invitation(), logged_in(served, Role.OPERATOR, "ben")
    assert [stranger.login("guessed") for _ in range(FREE_FAILURES + 2)] == [401] * FREE_FAILURES + [429] * 2
    assert int(stranger.headers["retry-after"]) >= 1
    assert stranger.login(token) == 429, "also the right one has to wait"
    assert friend.request("GET", "/session")[0] == 200
    failed = [text for level, text in served.logs if level == "WARNING"]
    assert len(failed) == FREE_FAILURES
    assert f"failed login {FREE_FAILURES} from {REMOTE}" in failed[-1]
    assert f"{FREE_FAILURES} failed logins, the last from {REMOTE}" in served.core.state()
    elsewhere = RemoteComputer(served.port, "127.0.0.3")
    assert elsewhere.login(token) == 200, "another computer does not wait"


# --- the end of a session ---------------------------------------------------------------------------------------------


def test_after_the_logout_the_cookie_opens_nothing_and_the_pages_are_closed(served):
    computer = logged_in(served, Role.OPERATOR)
    with computer.page() as page, computer.page() as other:
        token = page.first("hello")["csrf"]
        other.first("hello")
        cookie = computer.cookie
        assert computer.request("POST", "/logout", b"", x_csrf="guessed")[0] == 403
        assert computer.request("POST", "/logout", b"", x_csrf=token)[0] == 204
        assert computer.cookie == ""
        for closed in (page, other):
            closed.until(lambda closed=closed: closed.closed)
            assert closed.closed == (4401, page_hub.SESSION_ENDED)
    computer.cookie = cookie
    assert computer.request("GET", "/session")[0] == 401
    assert refused_page(computer) == 401
    assert ("INFO", f"audit: anna (operator, {REMOTE}): logout") in served.logs


def test_a_session_that_is_revoked_while_it_drives_leaves_zero_and_no_page(served):
    computer, friend = logged_in(served, Role.OPERATOR), logged_in(served, Role.OPERATOR, "ben")
    with computer.page() as page, friend.page() as other:
        other.first("hello")
        page.until(lambda: Velocity in map(type, served.published) or page.teleop(0.3))
        LoginStore(secure_folder()).revoke("anna")
        with suppress(ConnectionClosed):  # while a frame is sent
            page.until(lambda: page.closed or page.teleop(0.3))
        page.until(lambda: page.closed)
        assert isinstance(served.published[-1], Velocity)
        assert served.published[-1].v == 0
        assert other.closed is None
    lines = [text for _, text in served.logs]
    assert f"audit: anna (operator, {REMOTE}): teleop ends" in lines
    assert f"audit: anna (operator, {REMOTE}): the session is revoked or has expired" in lines


def test_a_session_that_expires_is_closed(served, monkeypatch):
    computer = logged_in(served, Role.OPERATOR)
    with computer.page() as page:
        page.first("hello")
        monkeypatch.setattr(served.device._hubs.first._sessions, "_now", lambda: 4e9)
        page.until(lambda: page.closed)
    assert computer.request("GET", "/session")[0] == 401


# --- names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("host", ["robot.local", "a.robots.example", "localhost", "127.0.0.1", REMOTE, "ROBOT.LOCAL"])
def test_a_name_of_the_certificate_is_a_host(served, host):
    assert RemoteComputer(served.port, host=host).request("GET", "/")[0] == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "robots.example", "a.b.robots.example", "robot.local.evil.example", "127.0.0.3", "0.0.0.0"]
)
def test_any_other_name_is_refused_also_with_a_session(served, host):
    computer = logged_in(served, Role.ADMIN)
    computer.host = f"{host}:{served.port}"
    assert computer.request("GET", "/")[0] == 403
    assert refused_page(computer) == 403
    assert computer.login(invitation()) == 403


def test_a_name_of_the_settings_is_a_host(monkeypatch, tmp_path):
    with serving_remote(monkeypatch, tmp_path, hosts=("robot.example",)) as served:
        assert RemoteComputer(served.port, host="robot.example").request("GET", "/")[0] == 200


def test_a_foreign_origin_is_refused_with_a_session(served):
    computer = logged_in(served, Role.ADMIN)
    for origin in ("https://evil.example", "null", f"http://{computer.host}", f"https://{REMOTE}"):
        assert refused_page(computer, origin=origin) == 403
        assert computer.request("GET", "/session", origin=origin)[0] == 403


# --- this computer ----------------------------------------------------------------------------------------------------


def test_this_computer_needs_no_login_unless_the_request_came_by_a_proxy_or_another_name(served, tmp_path):
    here = RemoteComputer(served.port, "127.0.0.1", host="localhost")
    assert '"admin"' in here.request("GET", "/session")[1]
    for header in ("x_forwarded_for", "forwarded", "via", "x_real_ip"):
        assert here.request("GET", "/session", **{header: "127.0.0.1"})[0] == 401
    assert RemoteComputer(served.port, "127.0.0.1").request("GET", "/session")[0] == 401


def test_another_computer_that_claims_to_be_this_one_needs_a_login(served):
    liar = RemoteComputer(served.port, host="localhost")
    assert liar.request("GET", "/session")[0] == 401
    assert liar.request("GET", "/session", x_forwarded_for="127.0.0.1")[0] == 401


def test_with_login_always_this_computer_needs_a_login_too(monkeypatch, tmp_path):
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path))
    with serving(monkeypatch, login="always", port=PortConfig(device="web://127.0.0.1:0")) as served:
        assert served.request("GET", "/session")[0] == 401
        with pytest.raises(InvalidStatus):
            Browser(served.port, read=False)
