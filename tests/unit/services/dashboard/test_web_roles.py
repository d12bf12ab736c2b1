# SPDX-License-Identifier: Apache-2.0
"""The page for other computers, over real HTTPS: what each role may do, what is recorded of it, and the certificate."""

import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.dashboard.address import page_address
from services.dashboard.certificate import PageCertificate, read_certificate
from services.dashboard.config import DashboardConfig
from shared.config import UserError
from shared.messages import Velocity
from shared.roles import FRAME_ROLES, OPERATION_ROLES, REQUEST_ROLES, ROUTE_ROLES, Role, may
from shared.runners.transport import StackAddress
from shared.secure_folder import SecureFolder
from tests.unit.services.dashboard.browser import SOON, Served
from tests.unit.services.dashboard.credentials import REMOTE, certificate_and_key, make_credentials
from tests.unit.services.dashboard.remote import RemoteComputer, invitation, logged_in, serving_remote


@pytest.fixture
def served(monkeypatch, tmp_path: Path) -> Iterator[Served]:
    with serving_remote(monkeypatch, tmp_path / "secure") as server:
        yield server


@pytest.fixture
def stranger(served) -> RemoteComputer:
    return RemoteComputer(served.port)


@pytest.mark.parametrize("role", Role)
def test_each_frame_request_and_operation_is_refused_or_passed_by_the_server_as_its_table_says(served, role):
    computer = logged_in(served, role)
    with computer.page() as page:
        page.first("hello")
        for request, needed in REQUEST_ROLES.items():
            reply = page.ask("ask", request=request, args={})
            assert (reply["reason"] == "role") == (not may(role, needed)), request
        for op, needed in OPERATION_ROLES.items():
            reply = page.ask("do", op=op, args={})
            assert (reply["reason"] == "role") == (not may(role, needed)), op
        if not may(role, Role.OPERATOR):
            assert served.link.asked == []
        fields = {
            "want": {"keys": []},
            "name": {"name": "x"},
            "ping": {"id": 1},
            "ask": {"id": 1, "request": "x"},
            "do": {"id": 1, "op": "x"},
            "teleop": {"v": 0.1, "w": 0.0, "n": 1},
        }
        for frame, needed in FRAME_ROLES.items():
            n = len(page.of("pong"))
            notes = len(page.of("note"))
            page.send(frame, **fields.get(frame, {}))
            page.send("ping", id=0)
            page.until(lambda n=n: [f for f in page.of("pong")[n:] if f["id"] == 0])
            refused = [f for f in page.of("note")[notes:] if "may not send" in f["text"]]
            assert bool(refused) == (not may(role, needed)), frame
    driven = any(isinstance(message, Velocity) and message.v for message in served.published)
    assert driven == may(role, FRAME_ROLES["teleop"])


@pytest.mark.parametrize("role", Role)
def test_downloads_and_uploads_need_the_role_of_their_table(served, role):
    computer = logged_in(served, role)
    with computer.page() as page:
        token = page.first("hello")["csrf"]
    answers = {
        "map_download": computer.request("GET", "/maps/office.zip"),
        "map_upload": computer.request("POST", "/maps?name=office", b"x", x_csrf=token),
        "recording_download": computer.request("GET", "/recordings/a.mcap"),
    }
    assert answers.keys() == ROUTE_ROLES.keys()
    for route, (status, text) in answers.items():
        assert status == (404 if may(role, ROUTE_ROLES[route]) else 403), text
    lines = [text for _, text in served.logs]
    assert (f"audit: anna ({role}, {REMOTE}): map_upload office" in lines) == may(role, ROUTE_ROLES["map_upload"])


def test_the_token_of_another_session_is_no_token(served):
    viewer, operator = logged_in(served, Role.VIEWER, "ben"), logged_in(served, Role.OPERATOR)
    with viewer.page() as page:
        token = page.first("hello")["csrf"]
    assert operator.request("POST", "/maps?name=office", b"x", x_csrf=token)[0] == 403


# --- audit and certificate --------------------------------------------------------------------------------------------


def test_no_token_is_among_what_is_recorded(served, stranger):
    token, unused = invitation(), invitation(Role.ADMIN, "ben")
    assert stranger.login("a-wrong-token-of-a-stranger") == 401
    assert stranger.login(token) == 200
    with stranger.page() as page:
        csrf = page.first("hello")["csrf"]
        page.send("stop")
        page.until(lambda: served.published)
        assert stranger.request("GET", f"/maps/{unused}.zip")[0] == 404
        cookie = stranger.cookie
        stranger.request("POST", "/logout", b"", x_csrf=csrf)
    recorded = b"".join(served.sent) + "\n".join(text for _, text in served.logs).encode()
    assert b"anna" in recorded
    for secret in (token, cookie, csrf, unused, "a-wrong-token-of-a-stranger"):
        assert secret.encode() not in recorded


def test_requests_that_are_refused_are_counted_without_a_line_for_each(served, stranger, monkeypatch):
    for _ in range(20):
        stranger.request("GET", "/maps/office.zip")
    lines = [text for _, text in served.logs if "audit: refused" in text]
    assert 1 <= len(lines) < 20
    assert REMOTE in lines[0]


def test_a_certificate_that_was_renewed_is_shown_without_a_restart(monkeypatch, tmp_path):
    monkeypatch.setattr("services.dashboard.web.RENEW_EVERY_S", 0.05)
    with serving_remote(monkeypatch, tmp_path, 10.5) as served:
        computer = logged_in(served, Role.VIEWER)
        with computer.page() as page:
            page.until(lambda: "ends in 10 days" in served.core.state())
            make_credentials(tmp_path, 300.0)
            page.until(lambda: "ends" not in served.core.state())
        shown = ssl.get_server_certificate((REMOTE, served.port), timeout=SOON)
    assert shown.strip() == (tmp_path / "robot.pem").read_text().strip()


def test_the_names_of_a_renewed_certificate_count_and_former_ones_do_not(monkeypatch, tmp_path):
    monkeypatch.setattr("services.dashboard.web.RENEW_EVERY_S", 0.05)
    with serving_remote(monkeypatch, tmp_path, 10.5) as served:
        by_new_name = RemoteComputer(served.port, host="new.robots.site")
        by_former_name = RemoteComputer(served.port, host="robot.local")
        assert (by_new_name.request("GET", "/")[0], by_former_name.request("GET", "/")[0]) == (403, 200)
        computer = logged_in(served, Role.VIEWER)
        with computer.page() as page:
            page.until(lambda: "ends in 10 days" in served.core.state())
            make_credentials(tmp_path, 300.0, (REMOTE, "new.robots.site"))
            page.until(lambda: "ends" not in served.core.state())
        assert (by_new_name.request("GET", "/")[0], by_former_name.request("GET", "/")[0]) == (200, 403)


def test_half_of_a_renewed_certificate_leaves_the_present_one_in_use(monkeypatch, tmp_path):
    tries = threading.Event()
    load = PageCertificate.load_into

    def load_again(certificate, context):
        try:
            load(certificate, context)
        except UserError:
            tries.set()
            raise

    monkeypatch.setattr("services.dashboard.web.RENEW_EVERY_S", 0.05)
    monkeypatch.setattr(PageCertificate, "load_into", load_again)
    with serving_remote(monkeypatch, tmp_path, 365.0) as served:
        logged_in(served, Role.VIEWER)
        before = (tmp_path / "robot.pem").read_text()
        folder, (certificate, _) = SecureFolder(tmp_path), certificate_and_key(20.5)
        folder.write(folder.robot_certificate, certificate)  # its key is not there yet
        assert tries.wait(SOON)
        shown = ssl.get_server_certificate((REMOTE, served.port), timeout=SOON)
        assert "ends" not in served.core.state()
    assert shown.strip() == before.strip()


@pytest.mark.parametrize(
    ("certificate", "key", "words"),
    [("none.pem", "robot.key", r"none\.pem: No such file"), ("robot.key", "robot.key", "is no certificate in PEM")],
)
def test_a_certificate_that_cannot_be_read_is_named(tmp_path, certificate, key, words):
    make_credentials(tmp_path)
    config = DashboardConfig(certificate=str(tmp_path / certificate), key=str(tmp_path / key))
    with pytest.raises(UserError, match=words):
        page_address(config, StackAddress())


def test_a_key_of_another_certificate_is_refused(tmp_path):
    first, second = make_credentials(tmp_path / "a"), make_credentials(tmp_path / "b", 100.0)
    certificate = read_certificate(first.robot_certificate, second.robot_key)
    with pytest.raises(UserError, match=r"robot\.key: .*mismatch"):
        certificate.context()


def test_a_second_login_of_a_browser_ends_its_first_session(served):
    computer = logged_in(served, Role.ADMIN)
    first = computer.cookie
    with computer.page() as page:
        page.first("hello")
        assert computer.login(invitation(Role.VIEWER, "ben")) == 200
        page.until(lambda: page.closed)
    assert '"ben"' in computer.request("GET", "/session")[1]
    computer.cookie = first
    assert computer.request("GET", "/session")[0] == 401


@pytest.mark.parametrize(("days", "words"), [(20.5, "ends in 20 days"), (-1.0, "has expired"), (40.0, "")])
def test_the_end_of_the_certificate_is_shown_before_it(monkeypatch, tmp_path, days, words):
    with serving_remote(monkeypatch, tmp_path, days) as served:
        computer = logged_in(served, Role.VIEWER)
        with computer.page() as page:
            page.send("ping", id=1)
            page.first("pong")
            assert [words in note["text"] for note in page.of("note")] == ([True] if words else [])
        assert words in served.core.state()
