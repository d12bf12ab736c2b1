# SPDX-License-Identifier: Apache-2.0
"""`zenav secure check`: what is open against the rules shows, what could not be seen is not called wrong."""

from shared.secure_folder import MemberRole, SecureFolder
from zenav.secure import members
from zenav.secure.check import NO, NO_SERVICE, YES, AccessRow, check_members, show_rows

RIGHT = AccessRow("publish cmd/teleop", "operator", YES, YES)
OPEN = AccessRow("publish cmd/vel", "operator", YES, NO)
CLOSED = AccessRow("publish cmd/teleop", "viewer", NO, YES)
UNSEEN = AccessRow("ask request/fault", "admin", NO_SERVICE, YES)


def test_a_cell_is_right_where_both_agree_or_no_service_runs():
    assert [row.is_right for row in (RIGHT, OPEN, CLOSED, UNSEEN)] == [True, False, False, True]


def test_the_table_marks_what_is_wrong(capsys):
    rows = [
        AccessRow("connect", "plain TCP", YES, NO),
        RIGHT,
        AccessRow("publish cmd/teleop", "viewer", NO, NO),
        OPEN,
        AccessRow("publish cmd/vel", "viewer", NO, NO),
        AccessRow("publish odom", "operator", NO, NO),
        AccessRow("publish odom", "viewer", NO, NO),
    ]
    show_rows(rows, as_json=False)
    told = capsys.readouterr().out
    assert told.count("WRONG") == 2
    assert "publish odom" not in told, "what is closed to all is a number"
    assert "1 topics were refused to all; 2 of 7 checks are wrong" in told


def test_a_member_that_is_revoked_or_added_during_a_check_stays_so(tmp_path):
    folder = str(tmp_path / "secure")
    members.init_folder("x80sv", folder, [])
    members.add_member("anna", MemberRole.OPERATOR, folder, tmp_path / "anna.pem", 10)
    place = SecureFolder(tmp_path / "secure")
    with check_members(place, "x80sv"):
        assert len(place.members()) == 5
        members.revoke_member("anna", folder)
        members.add_member("vera", MemberRole.VIEWER, folder, tmp_path / "vera.pem", 10)
    assert [(row.name, row.revoked) for row in place.members()] == [("anna", True), ("vera", False)]
