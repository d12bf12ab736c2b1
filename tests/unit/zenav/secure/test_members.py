# SPDX-License-Identifier: Apache-2.0
"""The folder of credentials: certificates of three kinds, members, and files that only their user reads."""

import json
import os
import stat
import threading
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID
from cryptography.x509.verification import PolicyBuilder, Store, VerificationError
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shared.config import UserError
from shared.credentials import credentials_file, credentials_for, parsed_credentials
from shared.secure_folder import MemberRole, SecureFolder
from zenav.secure import members as commands
from zenav.secure.authority import BEGIN, Authority, checked_host, fingerprint


@pytest.fixture
def place(tmp_path) -> SecureFolder:
    folder = SecureFolder(tmp_path / "secure")
    commands.init_folder("x80sv", str(folder.path), ["robot.example.org"])
    return folder


def add(place: SecureFolder, name: str, role: MemberRole = MemberRole.OPERATOR, days: int = 30) -> Path:
    out = place.path.parent / f"{name}-{len(place.members())}.pem"
    commands.add_member(name, role, str(place.path), out, days)
    return out


def test_the_folder_and_each_file_are_for_their_user_alone(place):
    add(place, "anna")
    assert stat.S_IMODE(place.path.stat().st_mode) == 0o700
    for file in (*place.path.iterdir(), *place.path.parent.glob("*.pem")):
        assert stat.S_IMODE(file.stat().st_mode) == 0o600, file


def test_members_that_are_added_at_once_are_all_kept(place, monkeypatch):
    issue, others, is_added = Authority.credentials, [], threading.Event()

    def add_bert():
        add(place, "bert")
        is_added.set()

    def issue_late(*arguments):
        """Another command begins where this one has read the list, and has not yet written it."""
        if not others:
            others.append(threading.Thread(target=add_bert))
            others[0].start()
            is_added.wait(1.0)
        return issue(*arguments)

    monkeypatch.setattr(Authority, "credentials", issue_late)
    add(place, "anna")
    others[0].join()
    assert {member.name for member in place.members()} == {"anna", "bert"}


def test_a_member_has_a_certificate_for_clients_and_the_robot_one_for_servers(place):
    member = x509.load_pem_x509_certificate(parsed_credentials(add(place, "anna").read_text(), "").certificate.encode())
    robot = x509.load_pem_x509_certificate(place.robot_certificate.read_bytes())

    def usage(certificate: x509.Certificate) -> list[x509.ObjectIdentifier]:
        return list(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)

    assert usage(member) == [ExtendedKeyUsageOID.CLIENT_AUTH]
    assert usage(robot) == [ExtendedKeyUsageOID.SERVER_AUTH]
    names = robot.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "robot.example.org" in names.get_values_for_type(x509.DNSName)
    authority = x509.load_pem_x509_certificate(place.authority_certificate.read_bytes())
    server = PolicyBuilder().store(Store([authority])).build_server_verifier(x509.DNSName("robot.example.org"))
    server.verify(robot, [])
    with pytest.raises(VerificationError):
        server.verify(member, [])


def test_certificates_hold_for_a_computer_that_begins_in_1970(place):
    robot = x509.load_pem_x509_certificate(place.robot_certificate.read_bytes())
    assert robot.not_valid_before_utc == BEGIN
    assert BEGIN.year == 1970
    authority = x509.load_pem_x509_certificate(place.authority_certificate.read_bytes())
    member = x509.load_pem_x509_certificate(parsed_credentials(add(place, "anna").read_text(), "").certificate.encode())
    builder = PolicyBuilder().store(Store([authority])).time(datetime(1970, 1, 3))
    builder.build_server_verifier(x509.DNSName("robot.example.org")).verify(robot, [])
    with pytest.raises(VerificationError):
        PolicyBuilder().store(Store([authority])).time(datetime(2100, 1, 1)).build_server_verifier(
            x509.DNSName("robot.example.org")
        ).verify(robot, [])
    assert member.not_valid_before_utc == BEGIN


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.sampled_from("ab"), st.sampled_from(["add", "revoke", "renew"])), max_size=12))
def test_no_certificate_name_is_used_twice_and_one_certificate_a_member_is_valid(tmp_path_factory, steps):
    place = SecureFolder(tmp_path_factory.mktemp("s") / "secure")
    commands.init_folder("x80sv", str(place.path), [])
    valid: set[str] = set()
    for name, step in steps:
        try:
            if step == "add":
                add(place, name)
            elif step == "revoke":
                commands.revoke_member(name, str(place.path))
            else:
                out = place.path.parent / f"{name}-{len(place.members())}.pem"
                commands.renew_certificates(name, str(place.path), out, 30, [])
            assert (name in valid) == (step != "add")
            valid = valid - {name} if step == "revoke" else valid | {name}
        except UserError:
            assert (name in valid) == (step == "add")
    rows = place.members()
    assert len({row.common_name for row in rows}) == len(rows)
    assert sorted(row.name for row in rows if not row.revoked) == sorted(valid)


def test_a_wrong_name_is_refused_and_nothing_is_written(place):
    for name, role in (
        ("Anna", "viewer"),
        ("../x", "viewer"),
        ("mapper", "viewer"),
        ("nobody", "service"),
        ("", "admin"),
    ):
        with pytest.raises(UserError):
            add(place, name, MemberRole(role))
    assert place.members() == []
    assert not list(place.path.parent.glob("*.pem"))


def test_a_file_that_exists_is_never_replaced(place, tmp_path):
    out = tmp_path / "kept.pem"
    out.write_text("mine")
    with pytest.raises(UserError, match="cannot be written"):
        commands.add_member("anna", MemberRole.VIEWER, str(place.path), out, 30)
    assert out.read_text() == "mine"
    assert place.members() == []


def test_a_folder_that_cannot_be_written_is_an_error_and_leaves_no_key(place, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        commands.init_folder("x80sv", str(tmp_path / "file"), [])
    monkeypatch.setattr(SecureFolder, "write_members", lambda self, members: self.write(tmp_path / "file" / "x", b""))
    out = tmp_path / "anna.pem"
    with pytest.raises(UserError, match="cannot be written"):
        commands.add_member("anna", MemberRole.OPERATOR, str(place.path), out, 30)
    assert not out.exists()


def test_keys_that_others_may_read_are_refused(place):
    os.chmod(place.authority_key, 0o644)
    with pytest.raises(UserError, match="others may read"):
        place.require()


def test_a_second_authority_in_a_folder_is_refused(place):
    before = fingerprint(place.authority_certificate.read_bytes())
    with pytest.raises(UserError, match="already"):
        commands.init_folder("x80sv", str(place.path), [])
    assert fingerprint(place.authority_certificate.read_bytes()) == before


def test_the_robots_certificate_is_renewed_in_time_by_itself_and_keeps_its_names(place):
    assert not commands.renew_own(place)
    row = json.loads(place.robot_file.read_text())
    soon = (commands.today() + timedelta(days=29)).isoformat()
    place.write(place.robot_file, json.dumps({**row, "until": soon}).encode())
    old = place.robot_certificate.read_bytes()
    assert commands.renew_own(place)
    assert place.robot_certificate.read_bytes() != old
    assert json.loads(place.robot_file.read_text())["names"] == row["names"]
    place.authority_key.unlink()
    place.write(place.robot_file, json.dumps({**row, "until": soon}).encode())
    assert not commands.renew_own(place), "the authority is kept elsewhere"


def test_credentials_that_replace_those_of_another_member_say_so(place, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    anna, ben = add(place, "anna"), add(place, "ben")
    for file in (anna, anna):
        commands.accept_credentials(file, "robot.local")
    assert "replaces" not in capsys.readouterr().out
    commands.accept_credentials(ben, "robot.local")
    assert "it replaces the credentials of anna for robot.local on this computer" in capsys.readouterr().out


def test_accepted_credentials_are_found_by_the_host(place, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.delenv("ZENAV_CREDENTIALS", raising=False)
    file = add(place, "anna")
    with pytest.raises(UserError, match="asks for credentials"):
        credentials_for("tls/robot.local:7448")
    commands.accept_credentials(file, "robot.local")
    assert credentials_for("tls/robot.local:7448") == parsed_credentials(file.read_text(), "")
    credentials_file("robot.local").chmod(0o644)
    with pytest.raises(UserError, match="others may read"):
        credentials_for("tls/robot.local:7448")


@pytest.mark.parametrize(
    "damage", [lambda t: "", lambda t: t[:300], lambda t: t.replace("zenav credentials", "x"), str.upper]
)
def test_a_damaged_file_is_no_credentials(place, damage):
    text = add(place, "anna").read_text()
    with pytest.raises(UserError, match="holds no credentials"):
        parsed_credentials(damage(text), "the file")


def test_a_name_that_a_check_would_remove_is_refused(place):
    with pytest.raises(UserError, match="zenav secure check"):
        commands.add_member("check-anna", MemberRole.VIEWER, str(place.path), None, 30)
    assert place.members() == []


@pytest.mark.parametrize("name", ["", "a b", "x/y", "-a", "a" * 300, "..", "a_b."])
def test_a_wrong_host_is_refused(name):
    with pytest.raises(UserError, match="no name of a host"):
        checked_host(name)


def test_a_damaged_authority_is_one_clear_error(place):
    place.authority_key.write_text("nothing")
    with pytest.raises(UserError, match="damaged"):
        Authority(place)
    place.authority_key.unlink()
    with pytest.raises(UserError, match="missing"):
        Authority(place)
