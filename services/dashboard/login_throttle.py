# SPDX-License-Identifier: Apache-2.0
"""Slows failed logins: for each address exponentially, and for all together by a ceiling. Times are s, monotonic.

Derived from OWASP's Authentication Cheat Sheet (login throttling); the numbers are our own.
"""

from collections import OrderedDict, deque
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address, ip_network

FREE_FAILURES = 3  # of an address, without a wait: a mistyped link
MAX_WAIT_S = 900.0
FORGET_S = 3600.0  # after the last failure of an address
MAX_ADDRESSES = 2000  # remembered; then the oldest is forgotten, and the ceiling holds
CEILING, CEILING_S = 60, 60.0
"""failures of all addresses, in so many s; then every login waits."""


@dataclass
class _Failures:
    n: int = 0
    at: float = 0.0  # s, of the last one


class LoginThrottle:
    """Failed logins by address."""

    def __init__(self) -> None:
        self._by_address: OrderedDict[str, _Failures] = OrderedDict()
        self._recent: deque[float] = deque(maxlen=CEILING)

    def wait(self, address: str, now: float) -> float:
        """s for which a login from this address is refused unseen; 0: it may try."""
        waits = [0.0]
        failures = self._by_address.get(network_of(address))
        if failures is not None:
            waits.append(failures.at + _wait_after(failures.n) - now)
        if len(self._recent) == CEILING:
            waits.append(self._recent[0] + CEILING_S - now)
        return max(waits)

    def fail(self, address: str, now: float) -> float:
        """Counts a failed login. Returns the wait (s) until the next one."""
        network = network_of(address)
        failures = self._by_address.pop(network, _Failures())
        if now - failures.at > FORGET_S:
            failures.n = 0
        failures.n, failures.at = failures.n + 1, now
        self._by_address[network] = failures
        while len(self._by_address) > MAX_ADDRESSES:
            self._by_address.popitem(last=False)
        self._recent.append(now)
        return self.wait(address, now)

    def succeed(self, address: str) -> None:
        """Forgets the failures of an address."""
        self._by_address.pop(network_of(address), None)


def network_of(address: str) -> str:
    """An IPv4 address itself, and the /64 network of an IPv6 address: one computer has all addresses of it."""
    try:
        parsed = ip_address(address)
    except ValueError:
        return ""
    if isinstance(parsed, IPv6Address):
        return str(parsed.ipv4_mapped or ip_network((parsed, 64), strict=False))
    return str(parsed)


def _wait_after(n: int) -> float:
    return 0.0 if n < FREE_FAILURES else min(MAX_WAIT_S, 2.0 ** min(n - FREE_FAILURES, 20))
