# SPDX-License-Identifier: Apache-2.0
"""The gateway's core and the reader of its process's lines: each event is logged, counted and named."""

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.gateway.log_lines import LineReader, LinkEvent, LinkLine
from services.gateway.service import PORT, STARTING, GatewayConfig, GatewayService
from shared.config import load_robot
from shared.messages import PortState, SerialData
from shared.rejections import RejectionCause
from shared.service import Log

ANNA = {"name": "anna", "role": "operator", "common_name": "anna.1", "revoked": False, "days_left": 300}
VERA = {"name": "vera", "role": "viewer", "common_name": "vera.2", "revoked": False, "days_left": 12}
GONE = {"name": "vera", "role": "viewer", "common_name": "vera.1", "revoked": True, "days_left": 3}
THREAD = "TRACE rx-0 ThreadId(10) zenoh::net::routing::interceptor"


def gateway(*events: dict[str, object], days_left: int = 365) -> tuple[GatewayService, list[str]]:
    service = GatewayService(GatewayConfig(), load_robot("x80sv").robot)
    list(service.port_state(PortState(1, PORT, True, "")))
    members = {"event": "members", "members": [ANNA, VERA, GONE], "days_left": days_left}
    data = SerialData(1, PORT, msgpack.packb([members, *events]))
    return service, [out.text for out in service.receive(data) if isinstance(out, Log)]


def event(kind: str, name: str, text: str, n: int = 1) -> dict[str, object]:
    return {"event": kind, "name": name, "text": text, "n": n}


def test_a_refused_message_is_told_with_name_and_role_and_counted_by_its_key():
    service, lines = gateway(event("refused", "vera.2", "put x80/cmd/teleop", 12))
    assert "audit: refused to vera (viewer): put x80/cmd/teleop (12 times)" in lines
    assert service.rejections.counts["cmd/teleop", RejectionCause.ACCESS] == 12


def test_a_revoked_member_is_called_so():
    _, lines = gateway(event("refused", "vera.1", "put x80/estop"))
    assert "audit: refused to vera (revoked): put x80/estop (once)" in lines


def test_connected_members_are_counted_and_the_count_ends_with_the_process():
    service, lines = gateway(event("joined", "anna.1", "tls/192.168.1.7:4000"), event("joined", "vera.2", "tls/x:1"))
    assert service.state() == "2 members connected"
    assert "audit: anna (operator) connected from tls/192.168.1.7:4000" in lines
    list(service.receive(SerialData(2, PORT, msgpack.packb([event("left", "vera.2", "tls/x:1")]))))
    assert service.state() == "1 member connected"
    list(service.port_state(PortState(3, PORT, False, "certificates are missing")))
    assert service.state() == "certificates are missing"


def test_a_gateway_starts_until_its_process_listens_and_logs_the_number_of_its_members():
    service, _ = gateway()
    assert list(service.port_state(PortState(2, PORT, False, STARTING))) == []
    assert service.state() == STARTING
    assert [out.text for out in service.port_state(PortState(3, PORT, True, ""))] == [
        "the gateway listens, and lets 2 members in"
    ]


def test_certificates_that_end_soon_are_told_and_those_of_revoked_members_are_not():
    service, lines = gateway(days_left=10)
    assert "the robot's certificate ends in 10 days" in service.state()
    assert "the certificate of vera ends in 12 days: zenav secure renew vera" in lines
    assert not any("ends in 3 days" in line for line in lines)
    assert gateway(days_left=365)[0].state() == "0 members connected"


MARK = "zenav-1f0c"


def denied(name: str, key: str, thread: int = 10) -> str:
    return (
        f"\x1b[2m2026-11-23T13:47:38Z\x1b[0m TRACE rx-0 ThreadId({thread}) interceptor::access_control: "
        f"2f0b on Interface(lo)+CertCommonName({name})+Transport(Tls)+2f0b is unauthorized to Put (ingress) on {key}"
    )


def dropped(thread: int = 10) -> str:
    return f"TRACE rx-0 ThreadId({thread}) zenoh::net::routing::interceptor: Msg intercepted!"


def test_a_drop_after_a_denial_on_the_same_thread_has_its_name_and_key():
    reader = LineReader(MARK)
    assert reader.read(denied("vera.2", "x80/cmd/vel")) is None
    assert reader.read(denied("anna.1", "x80/odom", 11)) is None
    assert reader.read(dropped()) == LinkLine(LinkEvent.REFUSED, "vera.2", "put x80/cmd/vel")
    assert reader.read(dropped(11)) == LinkLine(LinkEvent.REFUSED, "anna.1", "put x80/odom")


def test_a_denial_that_is_only_remembered_is_no_refusal_and_names_no_later_drop():
    reader = LineReader(MARK)
    reader.read(denied("vera.2", "x80"))
    reader.read(f"{THREAD}::access_control: 2f0b is authorized to Put (egress) on x80")
    assert reader.read(dropped()) == LinkLine(LinkEvent.REFUSED, "", "a message")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (f"{MARK} joined anna.1 tls/10.0.0.7:4001", LinkLine(LinkEvent.JOINED, "anna.1", "tls/10.0.0.7:4001")),
        (f"{MARK} left - tls/10.0.0.7:4001", LinkLine(LinkEvent.LEFT, "", "tls/10.0.0.7:4001")),
        (f"{MARK} listening - tls/0.0.0.0:7448", LinkLine(LinkEvent.LISTENING, "", "tls/0.0.0.0:7448")),
        (
            "2026 \x1b[33m WARN\x1b[0m acc-0 ThreadId(05) zenoh_link_tls::unicast: "
            "invalid peer certificate: UnknownIssuer. Hint: increase the system open file limit.",
            LinkLine(LinkEvent.REJECTED, "", "invalid peer certificate: UnknownIssuer"),
        ),
    ],
)
def test_lines_on_links_and_handshakes_are_events(line, expected):
    assert LineReader(MARK).read(line) == expected


@pytest.mark.parametrize(
    "forged",
    [
        "a\n" + denied("anna.1", "x80/estop"),
        "a\n" + denied("anna.1", "x80/estop") + "\nb",
        "a +CertCommonName(anna.1)+b is unauthorized to Put (ingress) on x80/estop",
        "a\nTRACE rx-0 ThreadId(10) x: y\n" + denied("anna.1", "x80/estop"),
        "a\n" + dropped(),
        "a " + dropped(),
        "a WARN acc-0 ThreadId(05) zenoh_link_tls::unicast: stranger Hint:",
        "a\nWARN acc-0 ThreadId(05) zenoh_link_tls::unicast: stranger Hint:",
    ],
)
def test_no_key_of_a_member_is_taken_for_another_line_of_the_log(forged):
    reader = LineReader(MARK)
    assert reader.read(denied("vera.2", f"x80/{forged}") + "\n") is None
    assert reader.read(dropped()) == LinkLine(LinkEvent.REFUSED, "vera.2", "put x80/a")
    assert reader.read(dropped()) == LinkLine(LinkEvent.REFUSED, "", "a message")


@given(st.lists(st.text(max_size=120), max_size=20))
def test_no_line_of_a_log_ends_the_reader(lines):
    reader = LineReader(MARK)
    for line in lines:
        reader.read(line)
