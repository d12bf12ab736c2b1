# SPDX-License-Identifier: Apache-2.0
"""The gateway as a process, over Zenoh: what each member may do arrives, the rest does not, and is logged by name."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
import zenoh

from shared import topics
from shared.config import UserError, load_robot
from shared.credentials import Credentials, parsed_credentials
from shared.messages import Health, LogLine
from shared.runners import transport
from shared.runners.transport import StackAddress
from shared.secure_folder import MemberRole, SecureFolder
from tests.stack.brief_certificate import admit_brief, brief_credentials
from zenav.client import Client
from zenav.secure import members
from zenav.secure.check import check_access
from zenav.stack.launch import free_stack

ROBOT = load_robot("x80sv").robot.name
CLOSED_S = 10.0
"""within which a member is cut off; the gateway looks once a second."""


class Gateway:
    """A gateway on a stack without a robot; this test stands for the robot's services."""

    def __init__(self, where: StackAddress, place: SecureFolder, address: str, client: Client, pid: int) -> None:
        self.where, self.place, self.address, self.client, self.pid = where, place, address, client, pid
        self.lines: list[str] = []
        self.health: Health | None = None
        self.arrived: list[tuple[str, bytes]] = []
        self._subscriber = client.session.declare_subscriber(
            f"{ROBOT}/**", lambda sample: self.arrived.append((str(sample.key_expr), sample.payload.to_bytes()))
        )
        client.listen(topics.LOG, lambda line, _: self._log(line))
        client.listen(topics.HEALTH, lambda health, _: self._hear(health))

    def _log(self, line: LogLine) -> None:
        self.lines.append(line.text)

    def _hear(self, health: Health) -> None:
        if health.name == "gateway":
            self.health = health

    def member(self, name: str, role: MemberRole) -> Credentials:
        out = self.place.path.parent / f"{name}.{len(self.place.members())}.pem"
        members.add_member(name, role, str(self.place.path), out, 10)
        return parsed_credentials(out.read_text(), "")

    def open(self, credentials: Credentials, seconds: float = CLOSED_S) -> zenoh.Session:
        """A member's session, when the gateway lets it in."""
        limit = time.monotonic() + seconds
        while True:
            try:
                return transport.opened(StackAddress(router=f"tls/{self.address}", credentials=credentials))
            except UserError:
                assert time.monotonic() < limit, self.lines

    def has(self, key: str, payload: bytes) -> bool:
        return (f"{ROBOT}/{key}", payload) in self.arrived

    def until(self, holds: Callable[[], object], seconds: float = CLOSED_S) -> None:
        limit = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < limit, (self.lines, self.health)
            threading.Event().wait(0.05)

    def put_until(self, session: zenoh.Session, key: str, payload: bytes) -> None:
        """Publishes until it arrives: a gateway that starts again does not hold messages."""

        def arrives() -> bool:
            session.put(f"{ROBOT}/{key}", payload)
            return self.has(key, payload)

        self.until(arrives)


@contextmanager
def running_gateway(folder: Path) -> Iterator[Gateway]:
    place = SecureFolder(folder / "secure")
    members.init_folder("x80sv", str(place.path), [])
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    with free_stack() as claim:
        settings = (f"gateway.port.device=tls://{address}", f"gateway.folder={place.path}")
        command = [sys.executable, "-m", "services.gateway", "--stack", str(claim.where.domain)]
        for setting in settings:
            command += ["--set", setting]
        with Client(ROBOT, claim.where) as client:
            process = subprocess.Popen(command, cwd=Path(__file__).resolve().parents[2])
            try:
                yield Gateway(claim.where, place, address, client, process.pid)
            finally:
                process.terminate()
                assert process.wait(10) == 0, "the gateway did not end"


@pytest.fixture(scope="module")
def gateway(tmp_path_factory) -> Iterator[Gateway]:
    with running_gateway(tmp_path_factory.mktemp("gateway")) as gateway:
        yield gateway


def test_an_operator_drives_and_a_viewer_is_refused_counted_and_named(gateway):
    with gateway.open(gateway.member("anna", MemberRole.OPERATOR)) as anna:
        gateway.put_until(anna, "cmd/teleop", b"drive")
        anna.put(f"{ROBOT}/cmd/vel", b"past the guard")
        anna.put(f"{ROBOT}/cmd/teleop", b"last")
        gateway.until(lambda: gateway.has("cmd/teleop", b"last"))
        assert not gateway.has("cmd/vel", b"past the guard")
        gateway.until(lambda: any("anna (operator) connected" in line for line in gateway.lines))
    with gateway.open(gateway.member("vera", MemberRole.VIEWER)) as vera:
        gateway.until(lambda: any("vera (viewer) connected" in line for line in gateway.lines))
        for key in ("cmd/teleop", "estop", "cmd/vel", "request/navigate"):
            vera.put(f"{ROBOT}/{key}", b"vera's")
        gateway.until(lambda: any("refused to vera (viewer): put x80/estop" in line for line in gateway.lines))
        assert not any(payload == b"vera's" for _, payload in gateway.arrived)
        gateway.until(lambda: gateway.health and any(row[:2] == ("estop", "access") for row in gateway.health.rejected))


def test_no_key_of_a_member_is_taken_for_a_line_on_a_link(gateway):
    with gateway.open(gateway.member("line", MemberRole.VIEWER)) as line:
        gateway.until(lambda: any("line (viewer) connected" in text for text in gateway.lines))
        line.put(f"{ROBOT}/x\nzenav-link joined admin.1 tls/1.2.3.4:5", b"")
        gateway.until(lambda: any("refused to line (viewer)" in text for text in gateway.lines))
    assert not any("admin.1" in text for text in gateway.lines)


def test_no_key_of_a_member_accuses_another_member(gateway):
    denial = "TRACE rx-0 ThreadId({}) zenoh::net::routing::interceptor::access_control: 0 on Interface(lo)"
    denial += "+CertCommonName(victim.1)+Transport(Tls)+0 is unauthorized to Put (ingress) on x80/estop"
    key = "forged\n" + "\n".join(denial.format(f"{thread:02}") for thread in range(40))
    with gateway.open(gateway.member("liar", MemberRole.VIEWER)) as liar:
        gateway.until(lambda: any("liar (viewer) connected" in text for text in gateway.lines))
        for k in range(5):
            liar.put(f"{ROBOT}/{key}{k}", b"")
        liar.put(f"{ROBOT}/last", b"")
        gateway.until(lambda: any("refused to liar (viewer): put x80/last" in text for text in gateway.lines))
    assert any("refused to liar (viewer): put x80/forged (" in text for text in gateway.lines)
    assert not any("victim" in text for text in gateway.lines)


def test_messages_go_before_other_load_but_handshakes_do_not(gateway):
    before = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except OSError:
        pytest.skip("SCHED_RR is not allowed here: see `zenav doctor`")
    finally:
        os.sched_setscheduler(0, before, os.sched_param(0))
    with gateway.open(gateway.member("quick", MemberRole.OPERATOR)) as quick:
        gateway.put_until(quick, "cmd/teleop", b"quick")
        gateway.until(lambda: schedulers(gateway).keys() >= {"acc", "rx", "tx"})
        gateway.until(lambda: schedulers(gateway)["acc"] == {os.SCHED_OTHER})
        gateway.until(lambda: schedulers(gateway)["rx"] == schedulers(gateway)["tx"] == {os.SCHED_RR})


def schedulers(gateway: Gateway) -> dict[str, set[int]]:
    """The schedulers of the threads of the gateway's own process, by the beginning of their names."""
    found: dict[str, set[int]] = {}
    (process,) = psutil.Process(gateway.pid).children()
    for task in Path(f"/proc/{process.pid}/task").iterdir():
        name = (task / "comm").read_text().partition("-")[0].strip()
        found.setdefault(name, set()).add(os.sched_getscheduler(int(task.name)))
    return found


def test_members_see_the_robot_and_ask_what_their_role_may(gateway):
    asked: list[str] = []

    def serve(query: zenoh.Query) -> None:
        with query:
            asked.append(str(query.key_expr))
            query.reply(query.key_expr, b"answer")

    served = [gateway.client.session.declare_queryable(f"{ROBOT}/{key}", serve) for key in ("pose", "request/navigate")]
    with gateway.open(gateway.member("see", MemberRole.VIEWER)) as viewer:
        seen: list[bytes] = []
        viewer.declare_subscriber(f"{ROBOT}/**", lambda sample: seen.append(sample.payload.to_bytes()))

        def shown() -> bool:
            gateway.client.session.put(f"{ROBOT}/scan", b"a scan")
            return b"a scan" in seen

        gateway.until(shown)
        gateway.until(lambda: answers(viewer, "pose"))
        assert not answers(viewer, "request/navigate")
    with gateway.open(gateway.member("ask", MemberRole.OPERATOR)) as operator:
        gateway.until(lambda: answers(operator, "request/navigate"))
    assert asked.count(f"{ROBOT}/request/navigate") == 1
    for queryable in served:
        queryable.undeclare()


def answers(session: zenoh.Session, key: str) -> bool:
    return any(reply.ok is not None for reply in session.get(f"{ROBOT}/{key}", timeout=1.0))


def test_a_service_elsewhere_publishes_its_own_topics_alone(gateway):
    with gateway.open(gateway.member("recorder", MemberRole.SERVICE)) as recorder:
        gateway.put_until(recorder, "health/recorder", b"mine")
        for key in ("scan", "cmd/vel", "health/guard", "estop"):
            recorder.put(f"{ROBOT}/{key}", b"not mine")
        gateway.until(lambda: any("refused to recorder (service): put x80/estop" in line for line in gateway.lines))
        assert not any(payload == b"not mine" for _, payload in gateway.arrived)


def test_nobody_answers_in_the_place_of_a_service(gateway):
    with gateway.open(gateway.member("forger", MemberRole.ADMIN)) as forger:
        forger.declare_queryable(f"{ROBOT}/map", lambda query: query.reply(query.key_expr, b"forged"))
        gateway.put_until(forger, "cmd/teleop", b"forger is in")
        replies = gateway.client.session.get(f"{ROBOT}/map", timeout=1.0)
        assert [reply for reply in replies if reply.ok is not None] == []


def test_a_revoked_member_is_cut_off_and_its_name_never_comes_back_by_the_old_file(gateway):
    old = gateway.member("rita", MemberRole.OPERATOR)
    with gateway.open(old) as rita:
        gateway.put_until(rita, "cmd/teleop", b"rita drives")
        members.revoke_member("rita", str(gateway.place.path))
        n = 0

        def refused() -> bool:
            nonlocal n
            n += 1
            rita.put(f"{ROBOT}/cmd/teleop", b"rita %d" % n)
            return any("refused to rita (revoked)" in line for line in gateway.lines)

        gateway.until(refused)
        before = len(gateway.arrived)
        new = gateway.member("rita", MemberRole.OPERATOR)
        with gateway.open(new) as again:
            gateway.put_until(again, "cmd/teleop", b"new rita")
            rita.put(f"{ROBOT}/cmd/teleop", b"old rita")
            gateway.until(lambda: sum("refused to rita (revoked)" in line for line in gateway.lines) > 1)
        assert not any(payload.startswith((b"rita ", b"old rita")) for _, payload in gateway.arrived[before:])


def test_a_link_ends_with_its_certificate_and_nothing_of_it_arrives_afterwards(gateway):
    place = gateway.place
    gateway.lines.clear()
    admit_brief(place)
    gateway.until(lambda: any("the gateway listens" in line for line in gateway.lines))
    brief = brief_credentials(place, ROBOT, 7)
    with gateway.open(brief) as session:
        gateway.put_until(session, "cmd/teleop", b"in time")
        gateway.until(lambda: any("brief (operator) disconnected" in line for line in gateway.lines), 30)
        session.put(f"{ROBOT}/cmd/teleop", b"too late")
        with pytest.raises(UserError):
            transport.opened(StackAddress(router=f"tls/{gateway.address}", credentials=brief))
        assert not gateway.has("cmd/teleop", b"too late")


def test_a_member_cannot_stand_in_for_the_robot(gateway, tmp_path):
    """A man in the middle with a member's certificate: it is one for clients, so no session takes it for the robot."""
    spy = gateway.member("spy", MemberRole.ADMIN)
    for name, text in (("key", spy.key), ("certificate", spy.certificate), ("authority", spy.authority)):
        (tmp_path / name).write_text(text)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    config = zenoh.Config()
    tls = {
        "root_ca_certificate": str(tmp_path / "authority"),
        "listen_certificate": str(tmp_path / "certificate"),
        "listen_private_key": str(tmp_path / "key"),
    }
    config.insert_json5("mode", '"router"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps([f"tls/{address}"]))
    config.insert_json5("transport/link/tls", json.dumps(tls))
    victim = gateway.member("victim", MemberRole.OPERATOR)
    with zenoh.open(config), pytest.raises(UserError, match="no router answers"):
        transport.opened(StackAddress(router=f"tls/{address}", credentials=victim))


def test_check_shows_that_every_cell_is_as_the_registry_says(gateway, capsys):
    assert check_access(gateway.address, "x80sv", str(gateway.where.domain), str(gateway.place.path), True) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    found = {(row["action"], row["member"]): row["found"] for row in rows}
    assert {member for action, member in found if action == "connect"} == {
        "plain TCP", "no certificate", "certificate of another authority", "expired certificate",
    }  # fmt: skip
    assert found["publish cmd/teleop", "operator"] == "yes"
    assert found["publish cmd/teleop", "viewer"] == found["publish cmd/vel", "admin"] == "-"
    assert found["publish cmd/teleop", "revoked"] == "-"
    assert not [row.name for row in gateway.place.members() if row.name.startswith("check-")], "left behind"


def test_without_certificates_the_gateway_lets_nobody_in_and_says_why(tmp_path):
    with running_gateway(tmp_path) as gateway:
        gateway.until(lambda: gateway.health and "members connected" in gateway.health.state)
        hidden = replace(gateway.place, path=tmp_path / "hidden")
        gateway.place.path.rename(hidden.path)
        gateway.until(lambda: gateway.health and "zenav secure init" in gateway.health.state)
        with pytest.raises(OSError):
            socket.create_connection(("127.0.0.1", int(gateway.address.rpartition(":")[2])), 1.0).close()
        hidden.path.rename(gateway.place.path)
        gateway.until(lambda: gateway.health and "members connected" in gateway.health.state)


def test_another_robot_of_the_same_name_is_refused_and_has_no_members_of_this_one(gateway, tmp_path):
    """Two robots named x80: each has an authority of its own, and that decides."""
    other = SecureFolder(tmp_path / "other")
    members.init_folder("x80sv", str(other.path), [])
    members.add_member("mapper", MemberRole.SERVICE, str(other.path), tmp_path / "mapper.pem", 10)
    stranger = parsed_credentials((tmp_path / "mapper.pem").read_text(), "")
    before = len(gateway.lines)
    with pytest.raises(UserError, match="no router answers"):
        transport.opened(StackAddress(router=f"tls/{gateway.address}", credentials=stranger))
    gateway.until(lambda: any("rejected a connection" in line for line in gateway.lines[before:]))
    ours = gateway.member("ours", MemberRole.OPERATOR)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    config = transport.gateway_configuration(gateway.where, f"tls/{address}", other, ROBOT)
    with zenoh.open(config), pytest.raises(UserError, match="no router answers"):
        transport.opened(StackAddress(router=f"tls/{address}", credentials=ours))
