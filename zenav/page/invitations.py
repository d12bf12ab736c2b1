# SPDX-License-Identifier: Apache-2.0
"""`zenav page`: invitations to the page with their link and QR code; sessions, and their end."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from io import StringIO

import segno

from services.dashboard.address import PageAddress, is_own_name, is_this_computer, page_address
from services.dashboard.config import DashboardConfig
from services.dashboard.login_store import LoginStore
from services.dashboard.logins import LOGIN_NAME, Login
from shared.config import UserError, configured, nearest
from shared.roles import Role
from shared.runners.transport import StackAddress, stack_address
from shared.secure_folder import secure_folder
from zenav.secure.authority import fingerprint

ALL = "all"
ANY_HOST = "0.0.0.0"


def invite(role: str, name: str, minutes: float, host: str, robot: str, stack: str, settings: list[str]) -> None:
    """Writes the link to stdout; its QR code and how to check the page's certificate to stderr."""
    name = name or role
    if not LOGIN_NAME.fullmatch(name) or name == ALL:
        raise UserError(f"{name!r} is no name of a user", "a letter, then letters, digits, blanks, . - _; not `all`")
    config = configured(robot, settings).section("dashboard", DashboardConfig)
    address = invited_address(config, stack_address(stack))
    with _reporting():
        token = LoginStore(secure_folder()).invite(name, Role(role), minutes)
    link = invitation_link(address, host, token)
    sys.stdout.write(f"{link}\n")
    sys.stdout.flush()
    is_guess = address.host == ANY_HOST and ANY_HOST not in config.port.device
    lines = ["the link needs a stack that runs with --page-host"] if is_guess else []
    lines += [f"{name} is {role} with this link: once, within {minutes:g} min", qr_text(link)]
    others = [
        name for name in address.hosts if name != address.shown_host and "*" not in name and not is_own_name(name)
    ]
    if others and not host:
        lines.append(f"the page has other names, for --host: {', '.join(others)}")
    if address.certificate is not None:
        authority = secure_folder().authority_certificate
        shown = authority if authority.is_file() else address.certificate.certificate
        lines.append(f"SHA-256 of {shown.name}, to compare in the browser: {fingerprint(shown.read_bytes())}")
    sys.stderr.write("\n".join(lines) + "\n")


def invited_address(config: DashboardConfig, where: StackAddress) -> PageAddress:
    """The address for pages that log in. Where the settings name this computer's own, that of `--page-host`.

    Raises UserError where the page has no certificate for it.
    """
    address = page_address(config, where)
    if is_this_computer(address.host) and config.login == "remote":
        device = f"web://{ANY_HOST}:{address.port}"
        port = config.port.model_copy(update={"device": device})
        address = page_address(config.model_copy(update={"port": port}), where)
    return address


def invitation_link(address: PageAddress, host: str, token: str) -> str:
    """The link. The token is in its fragment, which browsers do not send: no log of a server or proxy has it."""
    return f"{address.url_at(host.lower() or address.shown_host)}/#invite={token}"


def qr_text(text: str) -> str:
    """The QR code of a text in half blocks of a terminal."""
    out = StringIO()
    segno.make(text, error="l", micro=False).terminal(out, compact=True)
    return out.getvalue()


def list_sessions() -> None:
    """Writes a line for each session and each open invitation."""
    with _reporting():
        book = LoginStore(secure_folder()).book()
    for kind, rows in (("session", book.sessions), ("invitation", book.invitations)):
        for row in rows:
            sys.stdout.write(f"{kind:<11} {row.name:<20} {row.role:<9} {_time(row.created)} .. {_time(row.until)}\n")
    if not (book.sessions or book.invitations):
        sys.stderr.write("no sessions and no invitations\n")


def revoke(name: str) -> None:
    """Ends the sessions and invitations of a name, or all. Raises UserError where the name has none."""
    store = LoginStore(secure_folder())
    with _reporting():
        before = store.book()
        names = tuple(sorted({row.name for row in (*before.sessions, *before.invitations)}))
        if name != ALL and name not in names:
            raise UserError(f"{name} has no session and no invitation", nearest(name, names))
        before = store.revoke(None if name == ALL else name)
    sys.stdout.write(
        f"ended: {_count(before.sessions, name)} sessions, {_count(before.invitations, name)} invitations\n"
    )


def _count(rows: tuple[Login, ...], name: str) -> int:
    return sum(name in (ALL, row.name) for row in rows)


def _time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds).strftime("%Y-%m-%d %H:%M")


@contextmanager
def _reporting() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        hint = "run it as the user that runs the robot, or set ZENAV_SECURE"
        raise UserError(f"{error.filename or secure_folder().path}: {error.strerror}", hint) from None
