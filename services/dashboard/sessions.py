# SPDX-License-Identifier: Apache-2.0
"""The pages that are open: their names, roles, and what each shows."""

from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import Any

from shared.roles import Role


@dataclass
class PageSession:
    """One page. address: IP address of its computer.  is_login: it has logged in, so its name is that of the login.

    robot: of a site, that it shows; empty where the process has one alone.  keys: its topics.  debug: it also shows
    what local control sees.  n: its last teleop frame.  refused_at: ns, of the last line of the audit for each command
    that it may not give.  stopped_at: the same for STOP and its release at a site.
    """

    client: int
    name: str
    role: Role
    address: str
    is_login: bool = False
    robot: str = ""
    keys: frozenset[str] = frozenset()
    debug: bool = False
    n: int = -1
    refused_at: dict[str, int] = field(default_factory=dict)
    stopped_at: dict[tuple[str, bool], int] = field(default_factory=dict)


class PageSessions:
    """The open pages by their connection's number."""

    def __init__(self) -> None:
        self._sessions: dict[int, PageSession] = {}

    def open(self, client: int, address: str, name: str, role: Role | None) -> PageSession:
        """A new page. name: of its login; empty without one.  role: None where the shell's event has none."""
        session = PageSession(client, name or f"page {client}", role or role_of(address), address, bool(name))
        self._sessions[client] = session
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

    def of_each_robot(self) -> list[PageSession]:
        """One page of each robot that is shown."""
        return list({session.robot: session for session in self._sessions.values() if session.robot}.values())

    def listed(self) -> list[dict[str, Any]]:
        """The rows of the frame `clients`."""
        return [{"client": s.client, "name": s.name, "role": str(s.role)} for s in self._sessions.values()]


def role_of(host: str) -> Role:
    """The role by the address alone, as recordings from before the login need it."""
    try:
        return Role.ADMIN if ip_address(host).is_loopback else Role.VIEWER
    except ValueError:
        return Role.VIEWER
