# SPDX-License-Identifier: Apache-2.0
"""The files of invitations and sessions. `zenav page` writes them too, so each change holds a lock of the folder."""

import json
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from services.dashboard.logins import TOKEN_BYTES, Login, LoginBook, match
from shared.config import UserError
from shared.roles import Role
from shared.secure_folder import SecureFolder


class LoginStore:
    """Changes are for worker threads: they wait for the lock. now: s since 1970, on the wall clock."""

    def __init__(self, folder: SecureFolder, now: Callable[[], float] = time.time) -> None:  # noqa: TID251  # of logins
        self._folder, self._now = folder, now
        self._sessions: tuple[Login, ...] = ()
        self._read_state: tuple[int, int, int] | None = None  # of the sessions' file, as it was last read

    def invite(self, name: str, role: Role, minutes: float) -> str:
        """The token of a new invitation."""
        token = secrets.token_urlsafe(TOKEN_BYTES)
        with self._locked() as book:
            self._write(book, book.invite(token, name, role, self._now(), 60 * minutes))
        return token

    def redeem(self, invitation: str) -> tuple[str, Login] | None:
        """The token of a new session, and the session. None where the invitation is none, is used or has ended."""
        token = secrets.token_urlsafe(TOKEN_BYTES)
        with self._locked() as book:
            outcome = book.redeem(invitation, token, self._now())
            if outcome is None:
                return None
            self._write(book, outcome[0])
        return token, outcome[1]

    def end(self, digest: str) -> None:
        """Ends a session."""
        with self._locked() as book:
            self._write(book, book.end(digest))

    def revoke(self, name: str | None) -> LoginBook:
        """Ends the sessions and invitations of a name, or all (None). Returns the book as it was before."""
        with self._locked() as book:
            self._write(book, book.revoke(name))
        return book

    def book(self) -> LoginBook:
        """All that has not ended. Raises UserError where a file is damaged."""
        whole = LoginBook(_read(self._folder.invitations_file), _read(self._folder.sessions_file))
        return whole.expire(self._now())

    def session(self, token: str) -> Login | None:
        """The session of a token."""
        return match(token, self._current(), self._now())

    def is_open(self, digest: str) -> bool:
        """Whether a session has not ended."""
        return any(row.digest == digest and self._now() < row.until for row in self._current())

    def _current(self) -> tuple[Login, ...]:
        """The sessions on disk, read again after each change. A damaged file opens nothing."""
        try:
            state = self._folder.sessions_file.stat()
        except OSError:
            self._read_state, self._sessions = None, ()
            return ()
        key = (state.st_ino, state.st_mtime_ns, state.st_size)
        if key != self._read_state:
            try:
                self._sessions = _read(self._folder.sessions_file)
            except (UserError, OSError):
                self._sessions = ()
            self._read_state = key
        return self._sessions

    def _write(self, before: LoginBook, after: LoginBook) -> None:
        # invitations first: a crash between the two loses an invitation, and never opens two sessions with it
        if after.invitations != before.invitations:
            self._folder.write(self._folder.invitations_file, _bytes(after.invitations))
        if after.sessions != before.sessions:
            self._folder.write(self._folder.sessions_file, _bytes(after.sessions))

    @contextmanager
    def _locked(self) -> Iterator[LoginBook]:
        """The book, which no other process changes meanwhile."""
        with self._folder.locked():
            yield self.book()


def _read(file: Path) -> tuple[Login, ...]:
    try:
        rows = json.loads(file.read_text(encoding="utf-8"))
        return tuple(
            Login(str(r["digest"]), str(r["name"]), Role(r["role"]), float(r["created"]), float(r["until"]))
            for r in rows
        )
    except FileNotFoundError:
        return ()
    except (ValueError, TypeError, KeyError):
        raise UserError(f"{file} is no list of logins", "delete it: every page must log in again") from None


def _bytes(rows: tuple[Login, ...]) -> bytes:
    return json.dumps([asdict(row) for row in rows], indent=1).encode()
