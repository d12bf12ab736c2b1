# SPDX-License-Identifier: Apache-2.0
"""The pages that are open: their names, roles, and what each shows."""

from dataclasses import dataclass
from ipaddress import ip_address
from typing import Any

from shared.roles import Role


@dataclass
class PageSession:
    """One page. keys: its topics.  debug: it also shows what local control sees.  n: its last teleop frame."""

    client: int
    name: str
    role: Role
    keys: frozenset[str] = frozenset()
    debug: bool = False
    n: int = -1


class PageSessions:
    """The open pages by their connection's number."""

    def __init__(self) -> None:
        self._sessions: dict[int, PageSession] = {}

    def open(self, client: int, host: str) -> PageSession:
        """A new page of a computer."""
        session = self._sessions[client] = PageSession(client, f"page {client}", role_of(host))
        return session

    def close(self, client: int) -> bool:
        """Removes a page. Returns whether it was open."""
        return self._sessions.pop(client, None) is not None

    def get(self, client: Any) -> PageSession | None:
        """The page of a connection, if it is open."""
        return self._sessions.get(client) if type(client) is int else None

    def clear(self) -> None:
        """Removes every page."""
        self._sessions.clear()

    def __len__(self) -> int:
        return len(self._sessions)

    @property
    def clients(self) -> list[int]:
        """The numbers of all connections."""
        return list(self._sessions)

    @property
    def is_watching(self) -> bool:
        """Whether a page shows what local control sees."""
        return any(session.debug for session in self._sessions.values())

    def listed(self) -> list[dict[str, Any]]:
        """The rows of the frame `clients`."""
        return [{"client": s.client, "name": s.name, "role": str(s.role)} for s in self._sessions.values()]


def role_of(host: str) -> Role:
    """The role of a computer's pages by its address. Without credentials, this computer's users may do everything."""
    try:
        return Role.ADMIN if ip_address(host).is_loopback else Role.VIEWER
    except ValueError:
        return Role.VIEWER
