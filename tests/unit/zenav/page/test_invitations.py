# SPDX-License-Identifier: Apache-2.0
"""`zenav page`: the link, its QR code, sessions and their end."""

import re
from pathlib import Path

import pytest

from services.dashboard.login_store import LoginStore
from shared.config import UserError
from shared.roles import Role
from shared.secure_folder import SecureFolder
from tests.unit.services.dashboard.credentials import make_credentials
from zenav.page.invitations import invite, list_sessions, qr_text, revoke


@pytest.fixture
def folder(monkeypatch, tmp_path: Path) -> SecureFolder:
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path / "secure"))
    return make_credentials(tmp_path / "secure")


def invited(capsys, role: str = "operator", name: str = "anna", host: str = "", settings: tuple[str, ...] = ()) -> str:
    """The link that the command writes."""
    invite(role, name, 15, host, "x80sv", "3", list(settings))
    return capsys.readouterr().out.strip()


def test_the_link_has_a_name_of_the_certificate_and_its_token_logs_in_once(folder, capsys):
    link = invited(capsys)
    token = re.fullmatch(r"https://robot\.local:8603/#invite=([\w-]{43})", link)[1]
    opened = LoginStore(folder).redeem(token)
    assert opened is not None
    assert (opened[1].name, opened[1].role) == ("anna", Role.OPERATOR)
    assert LoginStore(folder).redeem(token) is None
    assert token not in folder.sessions_file.read_text() + folder.invitations_file.read_text()


def test_host_and_port_follow_the_arguments(folder, capsys):
    assert invited(capsys, host="10.0.0.5").startswith("https://10.0.0.5:8603/#")
    assert invited(capsys, settings=("dashboard.port.device=web://0.0.0.0:9000",)).startswith(
        "https://robot.local:9000/"
    )


def test_the_code_of_the_link_and_the_fingerprint_are_for_the_reader(folder, capsys):
    invite("viewer", "", 15, "", "x80sv", "0", [])
    said = capsys.readouterr()
    assert qr_text(said.out.strip()) in said.err
    assert re.search(r"SHA-256 of robot\.pem, .*: ([0-9A-F]{2}:){31}[0-9A-F]{2}\n", said.err)
    assert "viewer is viewer" in said.err
    assert "--page-host" in said.err, "the settings name this computer's own address"
    invite("viewer", "", 15, "", "x80sv", "0", ["dashboard.port.device=web://0.0.0.0"])
    assert "--page-host" not in capsys.readouterr().err


def test_without_a_certificate_there_is_no_invitation(monkeypatch, tmp_path):
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path))
    with pytest.raises(UserError, match="certificate") as refused:
        invite("viewer", "anna", 15, "", "x80sv", "0", [])
    assert "zenav secure init" in refused.value.hint
    assert list(tmp_path.iterdir()) == []


def test_behind_a_proxy_this_computers_own_address_is_invited_to(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path))
    assert invited(capsys, settings=("dashboard.login=always",)).startswith("http://127.0.0.1:8603/#invite=")


@pytest.mark.parametrize("name", ["all", "a/b", "x\n", "-a", "1", "a" * 41])
def test_a_name_that_is_none_is_refused(folder, name):
    with pytest.raises(UserError, match="no name of a user"):
        invite("viewer", name, 15, "", "x80sv", "0", [])


def test_sessions_are_listed_and_revoked_by_name(folder, capsys):
    store = LoginStore(folder)
    store.redeem(store.invite("anna", Role.OPERATOR, 15))
    store.invite("anna", Role.VIEWER, 15)
    store.invite("ben", Role.VIEWER, 15)
    list_sessions()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:3] for line in lines] == [
        ["session", "anna", "operator"],
        ["invitation", "anna", "viewer"],
        ["invitation", "ben", "viewer"],
    ]
    with pytest.raises(UserError, match="anne has no session") as refused:
        revoke("anne")
    assert "anna" in refused.value.hint
    revoke("anna")
    assert capsys.readouterr().out == "ended: 1 sessions, 1 invitations\n"
    revoke("all")
    list_sessions()
    said = capsys.readouterr()
    assert said.out == "ended: 0 sessions, 1 invitations\n"
    assert "no sessions" in said.err
