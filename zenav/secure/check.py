# SPDX-License-Identifier: Apache-2.0
"""`zenav secure check`: connects to the gateway as each role and without a certificate, and shows the access of each.

The gateway is asked, not our rules. A session on the robot watches what arrives of messages that each role publishes on
each topic. They hold a mark that no service takes for a message. A request without content is answered by a refusal
where it arrives, and by nothing where it does not.
"""

import json
import secrets
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import date, timedelta
from pathlib import Path

import zenoh

from shared import topics
from shared.access_rules import askable_keys, publishable_keys
from shared.config import UserError, configured
from shared.credentials import TLS, Credentials
from shared.requests import REQUESTS
from shared.runners import transport
from shared.runners.transport import StackAddress
from shared.secure_folder import Member, MemberRole, SecureFolder, secure_folder
from shared.topics import KEYS
from zenav.console.table import show_table
from zenav.secure.authority import Authority, new_authority
from zenav.secure.members import CHECK_PREFIX as PREFIX
from zenav.secure.members import today

ROLES = (MemberRole.VIEWER, MemberRole.OPERATOR, MemberRole.ADMIN)  # of the members that exist during a check
SETTLE_S = 20.0  # at most, until the gateway runs with other members
ANSWER_S = 1.0
REFUSED_MS = 1000  # without a connection, it was refused
MARK_BYTES = 24
TIMED_OUT = b"Timeout"  # payload of the error that Zenoh itself makes
REQUEST_KEYS = tuple(key for request in REQUESTS for key in request.keys)
YES, NO, NO_SERVICE = "yes", "-", "not running"


@dataclass(frozen=True, slots=True)
class AccessRow:
    """What one member was found to be able to do, and what its role may do."""

    action: str
    member: str
    found: str
    expected: str

    @property
    def is_right(self) -> bool:
        """Whether both agree, as far as it could be seen."""
        return self.found in (self.expected, NO_SERVICE)


def check_access(at: str, robot: str, stack: str, folder: str, as_json: bool) -> int:
    """Prints the table; returns 1 where something is open that must be closed, or the other way round."""
    place = secure_folder(folder).require()
    robot_name = configured(robot, []).robot.name
    local = transport.stack_address(stack)
    rows: list[AccessRow] = []
    with check_members(place, robot_name) as members, transport.opened(local) as on_robot:
        watcher = _Watcher(on_robot, robot_name)
        _wait_for_gateway(at, watcher, members["admin"])
        rows += list(_connections(at, place, members["viewer"]))
        for name, credentials in members.items():
            with transport.opened(StackAddress(router=TLS + at, credentials=credentials)) as session:
                rows += _actions(watcher, session, name)
    show_rows(rows, as_json)
    return 0 if all(row.is_right for row in rows) else 1


# --- members of the check ---------------------------------------------------------------------------------------------


@contextmanager
def check_members(place: SecureFolder, robot: str) -> Iterator[dict[str, Credentials]]:
    """Credentials by name: of each role, and of a revoked operator. The gateway starts again before and after.

    What others change of the list meanwhile holds.
    """
    authority, until, number = Authority(place), today() + timedelta(days=1), secrets.token_hex(4)
    rows = [Member(f"{PREFIX}{role}", role, f"{PREFIX}{role}.{number}", until.isoformat()) for role in ROLES]
    gone = Member(f"{PREFIX}revoked", MemberRole.OPERATOR, f"{PREFIX}revoked.{number}", until.isoformat(), revoked=True)
    with place.locked():
        place.write_members([*_own_members(place), *rows, gone])
    try:
        yield {
            row.name.removeprefix(PREFIX): authority.credentials(row.name, str(row.role), robot, row.common_name, until)
            for row in (*rows, gone)
        }
    finally:
        with place.locked():
            place.write_members(_own_members(place))


def _own_members(place: SecureFolder) -> list[Member]:
    """The members but for those of a check, as they are now."""
    return [row for row in place.members() if not row.name.startswith(PREFIX)]


def _wait_for_gateway(at: str, watcher: "_Watcher", credentials: Credentials) -> None:
    """Waits until the gateway knows the new members. Raises UserError where none answers."""
    deadline = time.monotonic() + SETTLE_S
    while time.monotonic() < deadline:
        try:
            with transport.opened(StackAddress(router=TLS + at, credentials=credentials)) as session:
                if watcher.sees(session, topics.TELEOP.key):
                    return
        except UserError:
            pass  # it is starting
    raise UserError(f"no gateway answers at {at}", "is it running? start it with zenav up --remote")


# --- what is tried ----------------------------------------------------------------------------------------------------


def _connections(at: str, place: SecureFolder, valid: Credentials) -> Iterator[AccessRow]:
    """Connections that must fail: without TLS, without a certificate, with another authority's, with one that ended."""
    yesterday = today() - timedelta(days=1)
    expired = Authority(place).credentials("expired", "admin", valid.robot, "expired", yesterday)
    foreign = _foreign(valid, today() + timedelta(days=1))
    without_certificate = {**valid.tls(), "connect_certificate_base64": None, "connect_private_key_base64": None}
    tries = {
        "plain TCP": ("tcp/" + at, None),
        "no certificate": (TLS + at, without_certificate),
        "certificate of another authority": (TLS + at, foreign.tls()),
        "expired certificate": (TLS + at, expired.tls()),
    }
    for what, (endpoint, tls) in tries.items():
        yield AccessRow("connect", what, YES if _connects(endpoint, valid, tls) else NO, NO)


def _foreign(valid: Credentials, until: date) -> Credentials:
    """Credentials with the name of a member, by an authority that was made now; it trusts the robot's."""
    with tempfile.TemporaryDirectory() as folder:
        place = SecureFolder(Path(folder))
        made = new_authority(valid.robot, today())
        place.write(place.authority_key, made.key)
        place.write(place.authority_certificate, made.certificate)
        credentials = Authority(place).credentials(valid.name, valid.role, valid.robot, valid.name, until)
    return replace(credentials, authority=valid.authority)


def _connects(endpoint: str, valid: Credentials, tls: dict[str, object] | None) -> bool:
    config = transport.configuration(StackAddress(router=endpoint, credentials=valid))
    config.insert_json5("connect/timeout_ms", json.dumps(REFUSED_MS))
    if tls is not None:
        given = {key: value for key, value in tls.items() if value is not None}
        given["enable_mtls"] = "connect_certificate_base64" in given
        config.insert_json5("transport/link/tls", json.dumps(given))
    try:
        zenoh.open(config).close()  # type: ignore[no-untyped-call]  # zenoh's own
    except zenoh.ZError:
        return False
    return True


class _Watcher:
    """A session on the robot: what arrived of which mark, and which requests have a service."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self.session, self.robot = session, robot
        self.arrived: dict[bytes, set[str]] = {}
        self.running = _answered(session, robot, secrets.token_bytes(MARK_BYTES))
        self._subscriber = session.declare_subscriber(f"{robot}/**", self._note)

    def sees(self, session: zenoh.Session, key: str) -> bool:
        """Whether what another session publishes on a key arrives within a second."""
        mark = secrets.token_bytes(MARK_BYTES)
        session.put(f"{self.robot}/{key}", mark)
        limit = time.monotonic() + 1.0
        while mark not in self.arrived and time.monotonic() < limit:
            threading.Event().wait(0.02)
        return mark in self.arrived

    def _note(self, sample: zenoh.Sample) -> None:
        mark = sample.payload.to_bytes()
        if len(mark) == MARK_BYTES:
            self.arrived.setdefault(mark, set()).add(str(sample.key_expr).removeprefix(f"{self.robot}/"))


def _actions(watcher: _Watcher, session: zenoh.Session, name: str) -> list[AccessRow]:
    """Publishes on each key, and asks each request, as one member."""
    publishable = [] if name == "revoked" else publishable_keys(name)
    askable = [] if name == "revoked" else askable_keys(name)
    mark = secrets.token_bytes(MARK_BYTES)
    for key in KEYS:
        session.put(f"{watcher.robot}/{key}", mark)
    answered = _answered(session, watcher.robot, mark)  # takes longer than the messages above
    rows = []
    for key in REQUEST_KEYS:
        found = YES if key in answered else NO if key in watcher.running else NO_SERVICE
        rows.append(AccessRow(f"ask {key}", name, found, YES if key in askable else NO))
    for key in KEYS:
        found = YES if key in watcher.arrived.get(mark, ()) else NO
        rows.append(AccessRow(f"publish {key}", name, found, YES if key in publishable else NO))
    return rows


def _answered(session: zenoh.Session, robot: str, mark: bytes) -> set[str]:
    """The requests without meaning that were answered within ANSWER_S, if only by a refusal."""
    asked = {key: session.get(f"{robot}/{key}", payload=mark, timeout=ANSWER_S) for key in REQUEST_KEYS}
    return {key for key, replies in asked.items() if _has_answer(replies)}


def _has_answer(replies: Iterable[zenoh.Reply]) -> bool:
    """Whether a service answered; a refusal by the gateway ends with Zenoh's own time-out."""
    return any(reply.err is None or reply.err.payload.to_bytes() != TIMED_OUT for reply in replies)


# --- the table --------------------------------------------------------------------------------------------------------


def show_rows(rows: list[AccessRow], as_json: bool) -> None:
    """Prints a line for each row as JSON, or two tables for people."""
    if as_json:
        for row in rows:
            line = {"action": row.action, "member": row.member, "found": row.found, "expected": row.expected}
            sys.stdout.write(json.dumps(line) + "\n")
        return
    connections = [row for row in rows if row.action == "connect"]
    show_table(
        "connections that must be refused",
        ("as", "connected"),
        [(row.member, row.found + ("" if row.is_right else "  WRONG")) for row in connections],
    )
    members = list(dict.fromkeys(row.member for row in rows if row.action != "connect"))
    cells = {(row.action, row.member): row.found + ("" if row.is_right else "  WRONG") for row in rows}
    actions = list(dict.fromkeys(row.action for row in rows if row.action != "connect"))
    table = [(action, *(cells[action, member] for member in members)) for action in actions]
    open_to_some = [line for line in table if set(line[1:]) != {NO}]
    show_table("what members can do", ("action", *members), open_to_some)
    wrong = sum(not row.is_right for row in rows)
    n = len(table) - len(open_to_some)
    sys.stdout.write(f"{n} topics were refused to all; {wrong} of {len(rows)} checks are wrong\n")
