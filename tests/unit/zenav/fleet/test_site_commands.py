# SPDX-License-Identifier: Apache-2.0
"""Commands of a site on wrong input: one line and a hint, before anything listens."""

import pytest

from services.gateway.log_lines import LinkEvent, LinkLine
from services.uplink.site_device import robot_credentials, site_endpoint
from shared.config import UserError
from shared.credentials import parsed_credentials
from shared.secure_folder import Member, MemberRole, SecureFolder
from zenav.fleet.site_page import run_site_page
from zenav.fleet.site_recordings import fetch_recording
from zenav.fleet.site_router import event_text, run_site
from zenav.secure.members import add_member, init_folder
from zenav.secure.tokens import issue_token
from zenav.stack.uplink import uplink_settings


@pytest.fixture
def place(tmp_path):
    place = SecureFolder(tmp_path / "secure")
    init_folder("plant@x80sv", str(place.path), [])
    return place


@pytest.mark.parametrize(
    ("listen", "local", "words"),
    [
        ("tcp/0.0.0.0:7449", "tcp/127.0.0.1:7447", "no address for robots"),
        ("tls/0.0.0.0:7449", "tcp/0.0.0.0:7447", "open to the network"),
        ("7449", "tcp/127.0.0.1:7447", "names no host"),
    ],
)
def test_a_router_of_a_site_that_would_let_strangers_in_does_not_start(place, listen, local, words):
    with pytest.raises(UserError, match=words):
        run_site(listen, local, str(place.path))


def test_without_certificates_there_is_no_router(tmp_path):
    with pytest.raises(UserError, match="no certificates") as error:
        run_site("tls/127.0.0.1:7449", "tcp/127.0.0.1:7447", str(tmp_path / "none"))
    assert "zenav secure init" in error.value.hint


def test_a_robot_becomes_a_member_by_its_name_and_gets_no_token(place, tmp_path):
    out = tmp_path / "red.pem"
    add_member("red", MemberRole.ROBOT, str(place.path), out, 10)
    credentials = parsed_credentials(out.read_text(), "")
    assert (credentials.name, credentials.role, credentials.robot) == ("red", "robot", "plant")
    assert robot_credentials("tls/x:1", str(out), "red") == credentials
    with pytest.raises(UserError, match="of red"):
        robot_credentials("tls/x:1", str(out), "blue")
    with pytest.raises(UserError, match="no name of a robot"):
        add_member("red-2", MemberRole.ROBOT, str(place.path), tmp_path / "x.pem", 10)
    with pytest.raises(UserError, match="red is a robot"):
        issue_token("red", str(place.path))


@pytest.mark.parametrize("site", ["tcp/host:7449", "tls/host", "tls/:7449", "host", ""])
def test_a_wrong_address_of_a_site_is_an_error(site):
    with pytest.raises(UserError, match="no address"):
        uplink_settings(site)
    assert site_endpoint("tls://host:7449") == "tls/host:7449"


def test_the_audit_of_the_router_names_robot_and_person():
    members = {"red.1": Member("red", MemberRole.ROBOT, "red.1", "2030-01-01")}
    assert event_text(LinkLine(LinkEvent.REFUSED, "red.1", "put blue/pose"), members) == (
        "audit: red (robot) may not put blue/pose"
    )
    assert event_text(LinkLine(LinkEvent.REJECTED, "", "no certificate"), {}) == (
        "audit: an unnamed connection rejected: no certificate"
    )


def test_a_page_of_a_site_needs_a_router_and_a_recording_its_name(tmp_path):
    with pytest.raises(UserError, match="no router"):
        run_site_page("red@x80sv", "3", "", [], "INFO")
    with pytest.raises(UserError, match="no name of a recording"):
        fetch_recording("red", "../x.mcap", tmp_path, "tcp/127.0.0.1:1")


def test_a_recording_for_a_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written: Not a directory"):
        fetch_recording("red", "a.mcap", tmp_path / "file" / "x", "tcp/127.0.0.1:1")
