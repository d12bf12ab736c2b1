# SPDX-License-Identifier: Apache-2.0
"""What the shell reports of logins, refusals and its certificate: lines of the audit, and the health's detail."""

from typing import Any

from shared.service import Log, Out
from shared.types import NS_PER_S

WARN_DAYS = 30
"""before the end of the certificate."""
SHOWN_FOR_NS = 600 * NS_PER_S  # for which failed logins are in the health's detail
DAY_NS = 86_400 * NS_PER_S

LINES = {
    "login": "login",
    "logout": "logout",
    "session_end": "the session is revoked or has expired",
    "upload": "map_upload {what}",
    "download": "recording_download {what}",
}
"""By event of a known user: the text of its line."""


class LoginReports:
    """The reports so far. Times are ns on the stack's clock."""

    def __init__(self) -> None:
        self.n_failed, self.failed_at, self.failed_from = 0, 0, ""
        self.certificate_until: int | None = None

    def take(self, event: dict[Any, Any], now: int) -> Out:
        """An event of the shell; one of another kind is ignored."""
        kind, address, what = str(event.get("event")), _short(event, "host"), _short(event, "what")
        if kind in LINES:
            user = f"{_short(event, 'name') or 'page'} ({_short(event, 'role')}, {address})"
            yield Log("INFO", f"audit: {user}: {LINES[kind].format(what=what)}")
        elif kind == "login_failed":
            self.n_failed, self.failed_at, self.failed_from = self.n_failed + 1, now, address
            yield Log("WARNING", f"audit: failed login {self.n_failed} from {address}: {what}")
        elif kind == "refused":
            yield Log("INFO", f"audit: refused {address}: {what} ({_number(event, 'n')} times)")
        elif kind == "certificate":
            self.certificate_until = _number(event, "until")

    def certificate_detail(self, now: int) -> str:
        """When the certificate ends, where that is soon; else empty."""
        if self.certificate_until is None:
            return ""
        days = (self.certificate_until - now) // DAY_NS
        if days >= WARN_DAYS:
            return ""
        return "the page's certificate has expired" if days < 0 else f"the page's certificate ends in {days} days"

    def detail(self, now: int) -> list[str]:
        """What the health shows."""
        details = [self.certificate_detail(now)]
        if self.n_failed and 0 <= now - self.failed_at < SHOWN_FOR_NS:
            details.append(f"{self.n_failed} failed logins, the last from {self.failed_from}")
        return [text for text in details if text]


def _short(event: dict[Any, Any], name: str) -> str:
    text = str(event.get(name, ""))[:80]
    return text if text.isprintable() else repr(text)


def _number(event: dict[Any, Any], name: str) -> int:
    value = event.get(name)
    return value if type(value) is int else 0
