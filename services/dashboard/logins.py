# SPDX-License-Identifier: Apache-2.0
"""Invitations and sessions of the page: which token opens what, and until when. Times are s since 1970.

An invitation opens one session. Tokens have 256 random bits, so their hash needs no salt and no slow function: NIST
SP 800-63B, section 5.1.2 (look-up secrets). Only hashes are stored.
"""

import hmac
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from hashlib import sha256

from shared.roles import Role

TOKEN_BYTES = 32
"""random bytes of a token."""
MAX_TOKEN = 100
"""characters of a token as a browser sends it."""
SESSION_LIFE_S = 30 * 86_400.0
MAX_ROWS = 200
"""invitations, and sessions: the oldest are dropped beyond it."""
LOGIN_NAME = re.compile(r"[^\W\d][\w .-]{0,39}")


@dataclass(frozen=True, slots=True)
class Login:
    """An invitation or a session, as it is stored.

    digest: SHA-256 of its token, hexadecimal.  created, until: s since 1970.
    """

    digest: str
    name: str
    role: Role
    created: float
    until: float


@dataclass(frozen=True, slots=True)
class LoginBook:
    """All invitations and sessions. Each change returns another book."""

    invitations: tuple[Login, ...] = ()
    sessions: tuple[Login, ...] = ()

    def invite(self, token: str, name: str, role: Role, now: float, life: float) -> "LoginBook":
        """With one more invitation, for `life` s."""
        row = Login(digest_of(token), name, role, now, now + life)
        return replace(self.expire(now), invitations=_newest((*self.invitations, row), now))

    def redeem(self, invitation: str, session: str, now: float) -> "tuple[LoginBook, Login] | None":
        """The token of an invitation for that of a session: the book afterwards, and the session. None: refused."""
        invited = match(invitation, self.invitations, now)
        if invited is None or now < invited.created:  # a clock that was set back brings no invitation back
            return None
        row = Login(digest_of(session), invited.name, invited.role, now, now + SESSION_LIFE_S)
        others = tuple(other for other in self.invitations if other.digest != invited.digest)
        return LoginBook(_newest(others, now), _newest((*self.sessions, row), now)), row

    def end(self, digest: str) -> "LoginBook":
        """Without a session."""
        return replace(self, sessions=tuple(row for row in self.sessions if row.digest != digest))

    def revoke(self, name: str | None) -> "LoginBook":
        """Without the sessions and invitations of a name; None: without any."""
        if name is None:
            return LoginBook()
        kept = [tuple(row for row in rows if row.name != name) for rows in (self.invitations, self.sessions)]
        return LoginBook(*kept)

    def expire(self, now: float) -> "LoginBook":
        """Without what has ended."""
        return LoginBook(_newest(self.invitations, now), _newest(self.sessions, now))


def match(token: str, rows: Iterable[Login], now: float) -> Login | None:
    """The row of a token, if it has not ended. The time that it takes does not depend on the token.

    A clock that is too early, as that of a computer that has just started, locks no user out.
    """
    digest, found = digest_of(token[:MAX_TOKEN]), None
    for row in rows:
        if hmac.compare_digest(row.digest.encode(), digest.encode()) and now < row.until:
            found = row
    return found


def digest_of(token: str) -> str:
    """SHA-256 of a token, hexadecimal."""
    return sha256(token.encode("utf-8", "surrogatepass")).hexdigest()


def _newest(rows: tuple[Login, ...], now: float) -> tuple[Login, ...]:
    return tuple(row for row in rows if now < row.until)[-MAX_ROWS:]
