# SPDX-License-Identifier: Apache-2.0
"""Invitations open one session each, sessions end when they shall, only hashes are stored, failed logins are slowed."""

import json
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.dashboard.login_store import LoginStore
from services.dashboard.login_throttle import CEILING, CEILING_S, FREE_FAILURES, MAX_WAIT_S, LoginThrottle
from services.dashboard.logins import MAX_ROWS, SESSION_LIFE_S, LoginBook, digest_of, match
from shared.config import UserError
from shared.roles import Role
from shared.secure_folder import SecureFolder

NAMES = ("anna", "ben")
LIFE_S = 900.0

actions = st.lists(
    st.one_of(
        st.tuples(st.just("invite"), st.sampled_from(NAMES)),
        st.tuples(st.just("redeem"), st.integers(0, 9)),
        st.tuples(st.just("end"), st.integers(0, 9)),
        st.tuples(st.just("revoke"), st.sampled_from((*NAMES, None))),
        st.tuples(st.just("wait"), st.sampled_from((1.0, LIFE_S, SESSION_LIFE_S))),
    ),
    max_size=30,
)


@given(actions)
@settings(max_examples=300)
def test_in_any_order_an_invitation_opens_at_most_one_session_and_none_after_its_end(steps):
    book, now = LoginBook(), 1000.0
    invited: list[tuple[str, str, float]] = []  # token, name, until
    revoked: set[str] = set()  # tokens of invitations and sessions
    opened: dict[str, str] = {}  # session by invitation
    for step, value in steps:
        if step == "invite":
            token = f"invitation {len(invited)}"
            invited.append((token, value, now + LIFE_S))
            book = book.invite(token, value, Role.OPERATOR, now, LIFE_S)
        elif step == "redeem" and value < len(invited):
            token, name, until = invited[value]
            outcome = book.redeem(token, f"session of {token}", now)
            assert (outcome is not None) == (token not in opened and token not in revoked and now < until)
            if outcome is not None:
                book, row = outcome
                assert (row.name, row.role, row.until) == (name, Role.OPERATOR, now + SESSION_LIFE_S)
                opened[token] = f"session of {token}"
        elif step == "end" and value < len(opened):
            session = list(opened.values())[value]
            book = book.end(digest_of(session))
            revoked.add(session)
        elif step == "revoke":
            book = book.revoke(value)
            ended = [token for token, name, _ in invited if value in (None, name)]
            revoked |= set(ended) | {opened[token] for token in ended if token in opened}
        elif step == "wait":
            now += value
        assert len(book.sessions) <= len(opened)
        for session in opened.values():
            found = match(session, book.sessions, now)
            assert found is None or (session not in revoked and now < found.until)


def test_a_session_ends_after_its_life():
    book = LoginBook().invite("i", "anna", Role.ADMIN, 0.0, 60.0)
    outcome = book.redeem("i", "s", 59.9)
    assert outcome is not None
    sessions = outcome[0].sessions
    assert match("s", sessions, 59.9 + SESSION_LIFE_S - 1) is not None
    assert match("s", sessions, 59.9 + SESSION_LIFE_S) is None
    assert match("s", sessions, 0.0) is not None, "a computer that starts without a clock locks no user out"
    assert book.redeem("i", "s", 60.0) is None


def test_a_clock_that_was_set_back_brings_no_invitation_back():
    book = LoginBook().invite("i", "anna", Role.VIEWER, 1000.0, 60.0)
    assert book.redeem("i", "s", 999.0) is None
    assert book.redeem("i", "s", 1059.0) is not None


def test_the_list_of_invitations_is_bounded():
    book = LoginBook()
    for i in range(MAX_ROWS + 5):
        book = book.invite(str(i), "anna", Role.VIEWER, 0.0, 60.0)
    assert len(book.invitations) == MAX_ROWS
    assert book.redeem("0", "s", 1.0) is None
    assert book.redeem(str(MAX_ROWS + 4), "s", 1.0) is not None


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> SecureFolder:
    return SecureFolder(tmp_path / "secure")


def test_only_hashes_are_on_disk_and_for_this_user_only(folder):
    store = LoginStore(folder)
    kept, used = store.invite("anna", Role.VIEWER, 15), store.invite("ben", Role.ADMIN, 15)
    opened = store.redeem(used)
    assert opened is not None
    written = b"".join(file.read_bytes() for file in folder.path.iterdir())
    for token in (kept, used, opened[0]):
        assert len(token) >= 43, "256 bits"
        assert token.encode() not in written
    assert digest_of(opened[0]).encode() in written
    assert {file.stat().st_mode & 0o777 for file in folder.path.iterdir()} == {0o600}
    assert folder.path.stat().st_mode & 0o777 == 0o700


def test_another_process_sees_a_session_and_its_end_at_once(folder):
    robot, command = LoginStore(folder), LoginStore(folder)
    opened = robot.redeem(command.invite("anna", Role.VIEWER, 15))
    assert opened is not None
    token, row = opened
    assert command.session(token) == row
    command.revoke("anna")
    assert robot.session(token) is None
    assert not robot.is_open(row.digest)


def test_an_invitation_that_many_redeem_at_once_opens_one_session(folder):
    token = LoginStore(folder).invite("anna", Role.VIEWER, 15)
    together = threading.Barrier(8)

    def redeem(_: int) -> bool:
        store = LoginStore(folder)
        together.wait()
        return store.redeem(token) is not None

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(redeem, range(8))) == 1


def test_a_session_that_has_expired_opens_nothing(folder):
    time = [1000.0]
    store = LoginStore(folder, lambda: time[0])
    opened = store.redeem(store.invite("anna", Role.VIEWER, 15))
    assert opened is not None
    assert store.is_open(opened[1].digest)
    time[0] += SESSION_LIFE_S
    assert store.session(opened[0]) is None
    assert not store.is_open(opened[1].digest)
    assert store.book() == LoginBook()


@pytest.mark.parametrize("content", ["", "{", "[1]", '[{"digest": "x"}]', "7"])
def test_a_damaged_file_opens_nothing_and_is_named(folder, content):
    store = LoginStore(folder)
    opened = store.redeem(store.invite("anna", Role.VIEWER, 15))
    assert opened is not None
    folder.sessions_file.write_text(content)
    assert store.session(opened[0]) is None
    with pytest.raises(UserError, match=r"sessions\.json"):
        store.book()


def test_a_role_that_is_none_is_a_damaged_file(folder):
    store = LoginStore(folder)
    store.invite("anna", Role.VIEWER, 15)
    rows = json.loads(folder.invitations_file.read_text())
    folder.invitations_file.write_text(json.dumps([{**rows[0], "role": "root"}]))
    with pytest.raises(UserError, match=r"invitations\.json"):
        store.book()


# --- slowing ----------------------------------------------------------------------------------------------------------


def test_failures_of_an_address_double_its_wait_up_to_a_limit():
    throttle, now, waits = LoginThrottle(), 0.0, []
    for _ in range(20):
        assert throttle.wait("10.0.0.1", now) <= 0
        waits.append(throttle.fail("10.0.0.1", now))
        now += waits[-1] + CEILING_S / CEILING
    assert waits[: FREE_FAILURES - 1] == [0.0] * (FREE_FAILURES - 1)
    assert waits[FREE_FAILURES - 1 : FREE_FAILURES + 4] == [1.0, 2.0, 4.0, 8.0, 16.0]
    assert waits[-1] == MAX_WAIT_S
    assert throttle.wait("10.0.0.2", now) == 0.0


def test_a_login_that_succeeds_and_time_forget_the_failures():
    throttle = LoginThrottle()
    for _ in range(10):
        throttle.fail("10.0.0.1", 0.0)
        throttle.fail("10.0.0.2", 0.0)
    throttle.succeed("10.0.0.1")
    assert throttle.wait("10.0.0.1", 1.0) == 0.0
    assert throttle.fail("10.0.0.2", 10_000.0) == 0.0


def test_all_addresses_of_an_ipv6_network_are_one_and_a_mapped_one_is_its_ipv4():
    throttle = LoginThrottle()
    for i in range(10):
        throttle.fail(f"2001:db8::{i:x}", 0.0)
        throttle.fail("::ffff:10.0.0.1", 0.0)
    assert throttle.wait("2001:db8::ffff", 0.0) > 0
    assert throttle.wait("2001:db8:0:1::1", 0.0) == 0.0
    assert throttle.wait("10.0.0.1", 0.0) > 0


def test_failures_from_many_addresses_reach_a_ceiling_that_holds_for_all():
    throttle = LoginThrottle()
    for i in range(CEILING):
        assert throttle.wait("10.9.9.9", 0.0) == 0.0
        throttle.fail(f"10.0.{i}.1", 0.0)
    assert throttle.wait("10.9.9.9", 1.0) == CEILING_S - 1.0
    assert throttle.wait("10.9.9.9", CEILING_S) == 0.0
