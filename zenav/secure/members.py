# SPDX-License-Identifier: Apache-2.0
"""`zenav secure init`, `add`, `revoke`, `renew`, `list` and `accept`: the folder of credentials and its members."""

import json
import os
import re
import sys
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

from shared.config import UserError, configured, nearest
from shared.credentials import credentials_file, parsed_credentials
from shared.secure_folder import RENEWAL_DAYS, Member, MemberRole, SecureFolder, secure_folder
from shared.topics import SERVICES
from zenav.console.table import show_table
from zenav.secure.authority import ROBOT_DAYS, Authority, checked_host, fingerprint, host_names, new_authority

NAME = re.compile(r"[a-z][a-z0-9_-]{0,39}")
ROBOT_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
CHECK_PREFIX = "check-"  # of the names of members that `zenav secure check` adds for a moment


def init_folder(robot: str, folder: str, hosts: list[str]) -> None:
    """Makes authority and robot's certificate. Raises UserError where there is a folder already."""
    place = secure_folder(folder)
    _require_empty(place)
    robot_name = configured(robot, []).robot.name
    names = list(dict.fromkeys([*(checked_host(host) for host in hosts), *host_names()]))
    authority = new_authority(robot_name, today())
    with place.locked():
        _require_empty(place)
        place.write(place.authority_key, authority.key)
        place.write(place.authority_certificate, authority.certificate)
        place.write_members([])
        _issue_robot(place, robot_name, names)
    _say(f"{place.path}: authority and certificate of {robot_name}, for {', '.join(names)}")
    _say(f"fingerprint of the authority: {fingerprint(authority.certificate)}")
    _say("keep authority.key safe: its owner decides about access")
    _say("next: zenav secure add NAME --role operator, and zenav up --remote")


def add_member(name: str, role: MemberRole, folder: str, out: Path | None, days: int) -> None:
    """Issues a certificate and writes the file for its owner. Raises UserError where the name is taken."""
    place = secure_folder(folder).require()
    if not NAME.fullmatch(name):
        raise UserError(f"{name!r} is no name of a member", "a small letter first; then small letters, digits, - and _")
    if name.startswith(CHECK_PREFIX):
        raise UserError(f"{name} is a name of `zenav secure check`, which removes it", "choose another one")
    if role is MemberRole.SERVICE and name not in SERVICES:
        raise UserError(f"{name} is not a service", nearest(name, SERVICES))
    if role is MemberRole.ROBOT and not ROBOT_NAME.fullmatch(name):
        raise UserError(f"{name!r} is no name of a robot", "a small letter first; then small letters, digits and _")
    if role is not MemberRole.SERVICE and name in SERVICES:
        raise UserError(f"{name} is the name of a service", "choose another one, or --role service")
    with place.locked():
        if any(member.name == name and not member.revoked for member in place.members()):
            raise UserError(f"{name} is a member already", f"zenav secure renew {name}, or revoke {name} first")
        _issue_member(place, name, role, out, days)


def renew_certificates(name: str, folder: str, out: Path | None, days: int, hosts: list[str]) -> None:
    """Renews the certificate of a member; without a name, the robot's. The old one of a member ends."""
    place = secure_folder(folder).require()
    with place.locked():
        if name:
            _issue_member(place, name, valid_member(place, name).role, out, days)
            return
        robot_name, names = _robot_of(place)
        names = list(dict.fromkeys([*(checked_host(host) for host in hosts), *names, *host_names()]))
        _issue_robot(place, robot_name, names)
        _say(f"{place.robot_certificate}: for {', '.join(names)}")


def renew_own(folder: SecureFolder) -> bool:
    """Renews the robot's certificate where it ends soon and the authority's key is here. Returns whether it did."""
    if folder.robot_days_left(today()) > RENEWAL_DAYS or not folder.authority_key.exists():
        return False
    with folder.locked():
        _issue_robot(folder, *_robot_of(folder))
    return True


def revoke_member(name: str, folder: str) -> None:
    """Ends a member's access: the gateway cuts its connections within some seconds.

    Raises UserError on a wrong name.
    """
    place = secure_folder(folder).require()
    with place.locked():
        valid_member(place, name)
        place.write_members([replace(row, revoked=True) if row.name == name else row for row in place.members()])
    _say(f"{name} has no access any more")


def list_members(folder: str, as_json: bool) -> None:
    """Shows the members, their roles and the days that their certificates hold."""
    place = secure_folder(folder).require()
    robot_name, _ = _robot_of(place)
    rows = [
        {
            "name": member.name,
            "role": str(member.role),
            "certificate": member.common_name,
            "until": member.until,
            "state": "revoked" if member.revoked else "expired" if member.days_left(today()) < 0 else "valid",
        }
        for member in place.members()
    ]
    if as_json:
        sys.stdout.write("".join(json.dumps(row) + "\n" for row in rows))
        return
    days = place.robot_days_left(today())
    title = f"{robot_name}: its own certificate ends in {days} days"
    show_table(title, ("name", "role", "certificate", "until", "state"), [tuple(row.values()) for row in rows])


def accept_credentials(file: Path, endpoint_host: str) -> None:
    """Keeps a file of `zenav secure add` for connections to a host. Raises UserError where it is none."""
    try:
        text = file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{file} cannot be read: {getattr(error, 'strerror', error)}", "name the file") from None
    credentials = parsed_credentials(text, str(file))
    target = credentials_file(checked_host(endpoint_host))
    place = SecureFolder(target.parent)
    replaced = _member_of(target)
    place.write(target, credentials.text().encode())
    _say(f"{credentials.name} ({credentials.role}) of {credentials.robot}")
    if replaced not in ("", credentials.name):
        _say(f"it replaces the credentials of {replaced} for {endpoint_host} on this computer")
    is_robot = credentials.role == MemberRole.ROBOT
    command = f"up --site tls/{endpoint_host}:7449" if is_robot else f"topic hz pose --stack tls/{endpoint_host}:7448"
    _say(f"try: zenav {command}")


def _member_of(file: Path) -> str:
    """The member of a file of credentials; empty where there is none."""
    try:
        return parsed_credentials(file.read_text(), str(file)).name
    except (OSError, UnicodeDecodeError, UserError):
        return ""


def valid_member(place: SecureFolder, name: str) -> Member:
    """The member of a name that is not revoked. Raises UserError where there is none."""
    valid = {member.name: member for member in place.members() if not member.revoked}
    if name not in valid:
        raise UserError(f"{name} is no member", nearest(name, tuple(valid)) if valid else "see zenav secure list")
    return valid[name]


def today() -> date:
    """The date of certificates, UTC."""
    return datetime.now(UTC).date()  # noqa: TID251  # certificates end by the wall clock


def _require_empty(place: SecureFolder) -> None:
    if place.authority_key.exists() or place.exists:
        raise UserError(f"{place.path} has an authority already", "add members: zenav secure add NAME")


def _issue_robot(place: SecureFolder, robot_name: str, names: list[str]) -> None:
    until = today() + timedelta(days=ROBOT_DAYS)
    issued = Authority(place).robot(names, until)
    place.write(place.robot_key, issued.key)
    place.write(
        place.robot_file, json.dumps({"robot": robot_name, "names": names, "until": until.isoformat()}).encode()
    )
    place.write(place.robot_certificate, issued.certificate)  # last: the gateway starts again when it changes


def _issue_member(place: SecureFolder, name: str, role: MemberRole, out: Path | None, days: int) -> None:
    robot_name, _ = _robot_of(place)
    members = place.members()
    common_name = f"{name}.{1 + sum(member.name == name for member in members)}"
    until = today() + timedelta(days=days)
    credentials = Authority(place).credentials(name, str(role), robot_name, common_name, until)
    target = out if out is not None else Path(f"{name}.pem")
    try:
        descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise UserError(f"{target} cannot be written: {error.strerror}", "name another file: --out FILE") from None
    kept = [replace(row, revoked=True) if row.name == name else row for row in members]
    try:
        with os.fdopen(descriptor, "w") as stream:
            stream.write(credentials.text())
        place.write_members([*kept, Member(name, role, common_name, until.isoformat())])
    except (OSError, UserError) as error:
        target.unlink()  # of no member: the next try finds no file in its way
        if isinstance(error, UserError):
            raise
        raise UserError(f"{target} cannot be written: {error.strerror}", "name another file: --out FILE") from None
    _say(f"{target}: {name}, {role}, until {until.isoformat()}; it holds a private key: give it to {name} alone")
    _say(f"{name} does: zenav secure accept {target.name} --host HOST")


def _robot_of(place: SecureFolder) -> tuple[str, list[str]]:
    try:
        row = json.loads(place.robot_file.read_text())
        return str(row["robot"]), [str(name) for name in row["names"]]
    except (OSError, ValueError, TypeError, KeyError):
        raise UserError(f"{place.robot_file} cannot be read", "restore it from a backup") from None


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
