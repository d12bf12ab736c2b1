# SPDX-License-Identifier: Apache-2.0
"""The folder of a robot's credentials: where it is, its files, and its list of members.

`zenav secure` writes it (zenav/secure). The gateway, the page and tools read it.
"""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import date
from enum import StrEnum
from pathlib import Path

from shared.config import UserError
from shared.roles import Role

FOLDER_MODE, FILE_MODE = 0o700, 0o600
LOCK_FILE = "folder.lock"
RENEWAL_DAYS = 30
"""before its end a certificate is renewed, or its user is warned."""


class MemberRole(StrEnum):
    """What a member is: a person in one of the roles of shared/roles.py, or a service on another computer.

    Of a site's folder also a robot.
    """

    VIEWER = Role.VIEWER
    OPERATOR = Role.OPERATOR
    ADMIN = Role.ADMIN
    SERVICE = "service"
    ROBOT = "robot"  # of a site: its name is that of a robot


@dataclass(frozen=True, slots=True)
class Member:
    """One certificate that the authority has issued.

    common_name: the certificate's; NAME.N, never used twice.  until: its last whole day, ISO 8601.
    """

    name: str
    role: MemberRole
    common_name: str
    until: str
    revoked: bool = False

    def days_left(self, today: date) -> int:
        """Days until it expires; negative afterwards."""
        return (date.fromisoformat(self.until) - today).days


@dataclass(frozen=True, slots=True)
class SecureFolder:
    """The files of the folder. Those of the authority may be kept elsewhere: only `zenav secure` needs them."""

    path: Path

    @property
    def authority_key(self) -> Path:
        return self.path / "authority.key"

    @property
    def authority_certificate(self) -> Path:
        return self.path / "authority.pem"

    @property
    def robot_key(self) -> Path:
        """Of the robot's own certificate, which gateway, page and Foxglove server show."""
        return self.path / "robot.key"

    @property
    def robot_certificate(self) -> Path:
        return self.path / "robot.pem"

    @property
    def robot_file(self) -> Path:
        """What the robot's certificate says: `robot`, `names` of the host, `until` (ISO 8601)."""
        return self.path / "robot.json"

    @property
    def members_file(self) -> Path:
        return self.path / "members.json"

    @property
    def invitations_file(self) -> Path:
        """Hashes of the page's invitations."""
        return self.path / "invitations.json"

    @property
    def sessions_file(self) -> Path:
        """Hashes of the page's sessions."""
        return self.path / "sessions.json"

    @property
    def tokens_file(self) -> Path:
        """Hashes of the tokens of members, for the Foxglove server."""
        return self.path / "tokens.json"

    @property
    def exists(self) -> bool:
        """Whether it holds the certificate of a robot."""
        return self.robot_certificate.is_file()

    def require(self) -> "SecureFolder":
        """Itself. Raises UserError where it holds no certificate of a robot, or others may read its keys."""
        if not self.exists:
            raise UserError(f"there are no certificates in {self.path}", "make them: zenav secure init")
        for key in (self.authority_key, self.robot_key):
            if key.exists() and key.stat().st_mode & 0o077:
                raise UserError(f"others may read {key}", f"chmod 600 {key}")
        return self

    def members(self) -> list[Member]:
        """All that were issued, the oldest first; revoked ones too.

        Raises UserError where the list is damaged or cannot be read.
        """
        try:
            rows = json.loads(self.members_file.read_text())
            members = [Member(**{**row, "role": MemberRole(row["role"])}) for row in rows]
            for member in members:
                date.fromisoformat(member.until)
            return members
        except FileNotFoundError:
            return []
        except OSError as error:
            hint = "run it as the user of the robot"
            raise UserError(f"{self.members_file} cannot be read: {error.strerror}", hint) from None
        except (ValueError, TypeError, KeyError, AttributeError):
            raise UserError(f"{self.members_file} is no list of members", "restore it from a backup") from None

    def robot_days_left(self, today: date) -> int:
        """Days until the robot's certificate expires. Raises UserError where robot.json is damaged."""
        try:
            return (date.fromisoformat(json.loads(self.robot_file.read_text())["until"]) - today).days
        except (OSError, ValueError, TypeError, KeyError):
            raise UserError(f"{self.robot_file} cannot be read", "make it again: zenav secure renew") from None

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Waits until no other process changes the folder, and holds it while the block runs, which may not nest.

        What a change depends on is read inside. The kernel releases the lock of a killed process. Raises UserError
        where the folder cannot be written.
        """
        file = self.path / LOCK_FILE
        try:
            self.path.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
            lock = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, FILE_MODE)
        except OSError as error:
            raise _unwritable(file, error) from None
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        finally:
            os.close(lock)

    def write_members(self, members: list[Member]) -> None:
        """Replaces the list."""
        self.write(self.members_file, json.dumps([asdict(member) for member in members], indent=1).encode())

    def write(self, file: Path, data: bytes) -> None:
        """Replaces a file of the folder at once, readable for this user only. Raises UserError where it cannot."""
        partial = file.with_name(f".{file.name}.{os.getpid()}")
        try:
            self.path.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
            descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, FILE_MODE)
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(file)
        except OSError as error:
            raise _unwritable(file, error) from None


def _unwritable(file: Path, error: OSError) -> UserError:
    hint = "run it as the user of the robot, or name another folder: --dir, or ZENAV_SECURE"
    return UserError(f"{file} cannot be written: {error.strerror}", hint)


def secure_folder(given: str = "") -> SecureFolder:
    """The folder that is given, or ZENAV_SECURE names, or `secure` in the user's configuration folder of zenav."""
    given = given or os.environ.get("ZENAV_SECURE", "")  # noqa: TID251  # services and tools find one folder
    return SecureFolder(Path(given) if given else configuration_folder() / "secure")


def configuration_folder() -> Path:
    """Where this user's zenav keeps what is not of one robot's working folder."""
    base = os.environ.get("XDG_CONFIG_HOME", "")  # noqa: TID251  # as freedesktop's base directories say
    return (Path(base) if os.path.isabs(base) else Path.home() / ".config") / "zenav"
