# SPDX-License-Identifier: Apache-2.0
"""`zenav site up`: the router of a site. Robots and people come in by TLS, programs of this computer by loopback.

It is a process of its own, started again when the list of members changes. Robots find it again, and drive meanwhile.
"""

import sys
from collections.abc import Mapping

from services.gateway.link_device import folder_version, today
from services.gateway.log_lines import LinkEvent, LinkLine
from services.gateway.router_process import RouterProcess
from shared.config import UserError
from shared.credentials import TLS, endpoint_host
from shared.secure_folder import RENEWAL_DAYS, Member, SecureFolder, secure_folder
from zenav.console.shutdown import StopFlag, stop_on_signal
from zenav.secure.members import renew_own
from zenav.stack.router import is_loopback

LOOK_S = 1.0  # between two looks at process and folder
AGAIN_S = 5.0  # between two starts of a process that ended by itself
EVENT_TEXTS = {
    LinkEvent.JOINED: "connected from",
    LinkEvent.LEFT: "disconnected,",
    LinkEvent.REFUSED: "may not",
    LinkEvent.REJECTED: "rejected:",
}


def run_site(listen: str, local: str, folder: str) -> int:
    """Routes until Ctrl-C. Raises UserError where an address is wrong, taken, or open to everybody."""
    place = secure_folder(folder).require()
    endpoint_host(listen)
    if not listen.startswith(TLS):
        raise UserError(f"{listen} is no address for robots", "write tls/0.0.0.0:7449: their link is encrypted")
    if not is_loopback(local):
        raise UserError(f"{local} is open to the network, and to everybody on it", "write tcp/127.0.0.1:7447")
    with stop_on_signal() as stop:
        is_first = True
        while not stop.is_set():
            renew_own(place)
            _warn(place)
            failure = _serve(place, listen, local, stop)
            if failure and is_first:
                raise UserError(failure, "is the port taken? see: ss -tlnp")
            is_first = False
            if failure:
                _say(f"{failure}; again in {AGAIN_S:g} s")
                stop.wait(AGAIN_S)
    return 0


def _serve(place: SecureFolder, listen: str, local: str, stop: StopFlag) -> str:
    """Runs the process until the folder or the date changes. Returns why it ended by itself, else nothing."""
    version, day = folder_version(place), today()
    names = {member.common_name: member for member in place.members()}
    order = {"local": local, "listen": listen, "folder": str(place.path)}
    process = RouterProcess(order, lambda line: _say(event_text(line, names)))
    failure, has_said = "", False
    while not failure and not stop.wait(LOOK_S) and folder_version(place) == version and today() == day:
        if process.listening.is_set() and not has_said:
            has_said = True
            _say(f"robots and people connect to {listen}, programs of this computer to {local}")
        failure = process.failure()
    process.end()
    return failure


def event_text(line: LinkLine, members: Mapping[str, Member]) -> str:
    """A line of the audit. members: by their certificates' names."""
    member = members.get(line.name)
    who = f"{member.name} ({member.role})" if member is not None else line.name or "an unnamed connection"
    return f"audit: {who} {EVENT_TEXTS[line.event]} {line.text}"


def _warn(place: SecureFolder) -> None:
    days = {member.name: member.days_left(today()) for member in place.members() if not member.revoked}
    for name, left in {**days, "the site": place.robot_days_left(today())}.items():
        if left <= RENEWAL_DAYS:
            _say(f"the certificate of {name} ends in {left} days: zenav secure renew")


def _say(text: str) -> None:
    sys.stderr.write(f"site: {text}\n")
    sys.stderr.flush()
