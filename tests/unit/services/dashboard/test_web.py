# SPDX-License-Identifier: Apache-2.0
"""The page's shell: what it refuses, what a page gets of the stack, and that a slow page waits alone."""

import asyncio
import select
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, suppress

import msgpack
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus, WebSocketException

from services.dashboard import page_hub, web_server
from services.dashboard.address import page_address
from services.dashboard.config import DashboardConfig
from services.dashboard.frames import MAX_FRAME
from services.dashboard.web_app import MAX_FRAMES, GrowingFileResponse
from services.dashboard.web_guard import POLICY
from shared.codec import decode
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import EmergencyStop, LaserScan, LogLine, MapUpdate, Odometry, Velocity
from shared.ports import PortConfig
from shared.runners.transport import StackAddress
from tests.unit.services.dashboard.browser import SOON, Browser, FakeLink, Served, serving


@pytest.fixture
def served(monkeypatch) -> Iterator[Served]:
    with serving(monkeypatch) as server:
        yield server


def config_of(device: str) -> DashboardConfig:
    return DashboardConfig(port=PortConfig(device=device))


def odometry(x: float) -> Odometry:
    return Odometry(1, Pose2(x, 0, 0), 0.0, 0.0, np.zeros(9))


def tiles(map_id: int, places: list[tuple[int, int]], value: int) -> MapUpdate:
    rows, columns = np.array([p[0] for p in places], np.int32), np.array([p[1] for p in places], np.int32)
    return MapUpdate(1, map_id, 1, 0.05, rows, columns, np.full((len(places), 4096), value, np.int8))


# --- addresses --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("device", "url"),
    [
        ("web://127.0.0.1", "http://127.0.0.1:8603"),
        ("web://localhost", "http://127.0.0.1:8603"),
        ("web://[::1]", "http://[::1]:8603"),
        ("web://127.0.0.1:9000", "http://127.0.0.1:9000"),
    ],
)
def test_the_port_is_8600_and_the_stacks_number_unless_it_is_named(device, url):
    assert page_address(config_of(device), StackAddress(3)).url == url


@pytest.mark.parametrize(
    "device",
    ["web://0.0.0.0", "web://192.168.1.7:8600", "web://[::]", "web://robot.local", "web://127.0.0.2"],
)
def test_an_address_for_other_computers_is_refused_without_a_certificate(device, monkeypatch, tmp_path):
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path / "none"))
    with pytest.raises(UserError, match=r"dashboard\.port\.device") as refused:
        page_address(config_of(device), StackAddress())
    assert "zenav secure init" in refused.value.hint


@pytest.mark.parametrize("device", ["web://", "web://127.0.0.1:x", "x", "web://127.0.0.1/path"])
def test_what_is_no_address_is_refused_with_an_example(device):
    with pytest.raises(UserError, match=r"dashboard\.port\.device") as refused:
        page_address(config_of(device), StackAddress())
    assert "web://127.0.0.1" in refused.value.hint


# --- HTTP -------------------------------------------------------------------------------------------------------------


def test_the_page_comes_with_a_strict_policy(served):
    status, headers, body = served.request("GET", "/")
    assert (status, headers["content-security-policy"], headers["x-content-type-options"]) == (200, POLICY, "nosniff")
    assert "unsafe" not in POLICY
    assert b"<script>" not in body
    assert served.request("GET", "/static/index.html")[0] == 200
    assert "server" not in headers


@pytest.mark.parametrize(
    "path", ["/static/../web.py", "/static/%2e%2e/web.py", "/static/..%2fweb.py", "/etc/passwd", "/static/"]
)
def test_no_other_file_is_served(served, path):
    assert served.request("GET", path)[0] == 404


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8600", "127.0.0.1.evil.example", "", "localhost/x", "u@localhost"]
)
def test_a_foreign_host_is_refused(served, host):
    assert served.request("GET", "/", host=host)[0] in (400, 403)
    name = host.partition(":")[0].partition("/")[0] or "x"
    with closing(socket.create_connection(("127.0.0.1", served.port), SOON)) as sock:
        if name not in ("localhost", "u@localhost"):
            with pytest.raises(InvalidStatus) as refused:
                Browser(served.port, name, sock=sock, read=False)
            assert refused.value.response.status_code == 403


def test_a_foreign_origin_is_refused(served):
    for origin in ("http://evil.example", "http://127.0.0.1:1", "https://localhost", "null"):
        status, headers, _ = served.request("GET", "/", origin=origin)
        assert (status, headers["content-security-policy"]) == (403, POLICY)
        with pytest.raises(InvalidStatus):
            Browser(served.port, origin=origin, read=False)
    with Browser(served.port, origin=f"http://127.0.0.1:{served.port}") as page:
        page.first("hello")


def test_the_answer_to_a_refused_post_comes_also_where_its_body_is_late(served):
    """A server that closes a connection with unread bytes resets it."""
    for _ in range(5):
        with socket.create_connection(("127.0.0.1", served.port), timeout=5) as connection:
            head = f"POST /maps?name=office HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nContent-Length: 4\r\n\r\n"
            connection.sendall(head.encode())
            assert not select.select([connection], [], [], 0.1)[0], "it waits for the body"
            connection.sendall(b"body")
            answer = b""
            while part := connection.recv(4096):
                answer += part
        assert answer.startswith(b"HTTP/1.1 403")
        assert b"reload the page" in answer


def test_a_refused_post_whose_body_never_comes_is_answered_all_the_same(served):
    with socket.create_connection(("127.0.0.1", served.port), timeout=5) as connection:
        head = f"POST /maps HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nContent-Length: 4\r\n\r\n"
        connection.sendall(head.encode())
        assert connection.recv(4096).startswith(b"HTTP/1.1 403")


def test_a_post_needs_the_token_of_hello(served):
    path = "/maps?name=office"
    assert served.request("POST", path, b"x")[0] == 403
    assert served.request("POST", path, b"x", x_csrf="guessed")[0] == 403
    with Browser(served.port) as page:
        token = page.first("hello")["csrf"]
    status, _, body = served.request("POST", path, b"x", x_csrf=token)
    assert (status, b"no tools" in body) == (404, True)
    assert served.request("POST", "/maps?name=..", b"x", x_csrf=token)[0] == 400


def test_an_upload_over_the_limit_is_refused(served, monkeypatch):
    monkeypatch.setattr("services.dashboard.web_app.MAX_UPLOAD", 1000)
    with Browser(served.port) as page:
        token = page.first("hello")["csrf"]
    status, _, body = served.request("POST", "/maps?name=office", bytes(1001), x_csrf=token)
    assert (status, b"more than 1000 bytes" in body) == (400, True)


def test_who_sends_half_a_request_is_disconnected(served, monkeypatch):
    monkeypatch.setattr(web_server, "REQUEST_LIMIT_S", 0.2)
    for start in (b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Long: "):
        with closing(socket.create_connection(("127.0.0.1", served.port), SOON)) as slow:
            slow.sendall(start)
            with suppress(ConnectionResetError):
                assert slow.recv(1000) == b""


def test_a_head_that_never_ends_is_refused(served):
    with closing(socket.create_connection(("127.0.0.1", served.port), SOON)) as big:
        big.sendall(b"GET / HTTP/1.1\r\nX-Big: " + b"x" * (2 * web_server.MAX_HEAD))
        assert b"400" in big.recv(1000)


def test_more_connections_than_the_limit_are_refused(served, monkeypatch):
    monkeypatch.setattr(web_server, "MAX_CONNECTIONS", 3)
    pages = [Browser(served.port) for _ in range(3)]
    try:
        with pytest.raises(WebSocketException):
            Browser(served.port, read=False)
        pages[0].first("hello")
    finally:
        for page in pages:
            page.socket.close()
    with closing(socket.create_connection(("127.0.0.1", served.port), SOON)):
        pass


# --- frames -----------------------------------------------------------------------------------------------------------


def test_a_frame_over_the_limit_closes_the_page(served):
    with Browser(served.port) as page, Browser(served.port) as other:
        other.until(lambda: other.of("clients") and len(other.of("clients")[-1]["clients"]) == 2)
        page.socket.send(bytes(MAX_FRAME + 1))
        page.until(lambda: page.closed)
        assert page.closed is not None
        assert page.closed[0] == 1009
        other.until(lambda: len(other.of("clients")[-1]["clients"]) == 1)


def test_more_frames_in_a_second_than_the_limit_close_the_page_with_the_reason(served):
    with Browser(served.port) as page:
        page.first("hello")
        for i in range(MAX_FRAMES + 1):
            page.send("ping", id=i)
        page.until(lambda: page.closed)
        assert page.closed == (1008, f"more than {MAX_FRAMES} frames in a second")


def test_a_frame_of_text_closes_the_page(served):
    with Browser(served.port) as page:
        page.socket.send("stop")
        page.until(lambda: page.closed)
        assert page.closed is not None
        assert page.closed[0] == 1008


def test_a_ping_is_answered_and_a_bad_frame_is_a_note(served):
    with Browser(served.port) as page:
        page.send("ping", id=7)
        assert page.first("pong")["id"] == 7
        page.socket.send(b"\xc1")
        assert page.first("note")["level"] == "error"


def test_the_page_that_drives_and_is_gone_leaves_zero(served):
    with Browser(served.port) as page:
        page.first("hello")
        page.until(lambda: Velocity in map(type, served.published) or page.teleop(0.3))
        page.socket.cut()
        page.until(lambda: isinstance(served.published[-1], Velocity) and served.published[-1].v == 0)


def test_stop_of_a_page_is_published(served):
    with Browser(served.port) as page:
        page.send("stop")
        page.until(lambda: any(isinstance(m, EmergencyStop) and m.pressed for m in served.published))


def test_a_request_is_asked_and_its_reply_comes_to_the_page_that_asked(served):
    with Browser(served.port) as page, Browser(served.port) as other:
        other.first("hello")
        reply = page.ask("ask", request="request/cancel", args={})
        assert (reply["accepted"], reply["data"]) == (True, {"task_id": 1})
        assert served.link.asked == ["request/cancel"]
        assert other.of("reply") == []


def test_a_page_that_comes_while_the_link_opens_for_one_that_is_gone_keeps_the_link(served, monkeypatch):
    monkeypatch.setattr(page_hub, "LINGER_S", 0.1)
    waiting, may_open = threading.Event(), threading.Event()

    def connect(link: FakeLink) -> None:
        waiting.set()
        assert may_open.wait(SOON)
        link.is_open = True

    monkeypatch.setattr(FakeLink, "connect", connect)
    first = Browser(served.port)
    assert waiting.wait(SOON)
    first.socket.close()
    with Browser(served.port) as second:
        threading.Event().wait(0.1)  # it queues behind the first one
        may_open.set()
        second.first("hello")
        threading.Event().wait(0.5)  # longer than the link of a page that is gone stays
        assert served.link.is_open


@pytest.mark.parametrize("grows", [0, 50_000, 500_000])
def test_of_a_recording_that_is_being_written_comes_what_was_there(tmp_path, grows):
    path = tmp_path / "drive.mcap"
    path.write_bytes(b"x" * 200_000)
    sent: list[dict] = []

    async def send(message: dict) -> None:
        if message["type"] == "http.response.start":
            with path.open("ab") as file:
                file.write(b"y" * grows)
        sent.append(message)

    async def receive() -> None:
        await asyncio.Event().wait()

    asyncio.run(GrowingFileResponse(path)({"type": "http", "method": "GET", "headers": []}, receive, send))
    start, *parts = sent
    assert (b"content-length", b"200000") in start["headers"]
    assert b"".join(part["body"] for part in parts) == b"x" * 200_000
    assert [part["more_body"] for part in parts] == [True] * (len(parts) - 1) + [False]


# --- topics -----------------------------------------------------------------------------------------------------------


def test_the_stack_is_heard_only_while_a_page_wants_it(served):
    with Browser(served.port) as first, Browser(served.port) as second:
        first.send("want", keys=["pose", "scan"])
        second.send("want", keys=["scan"])
        first.until(lambda: served.link.keys == {"pose", "scan"})
        first.send("want", keys=[])
        first.until(lambda: served.link.keys == {"scan"})
        second.socket.close()
        first.until(lambda: not served.link.keys)


def test_a_page_gets_the_bytes_of_the_messages_that_it_wants(served):
    with Browser(served.port) as page, Browser(served.port) as other:
        page.send("want", keys=["odom"])
        page.until(lambda: served.link.keys)
        served.link.publish("odom", odometry(1.5))
        frame = page.first("m")
        assert (frame["k"], decode(Odometry, frame["b"])[0].odom_from_base.x) == ("odom", 1.5)
        other.first("hello")
        assert other.of("m") == []
        other.send("want", keys=["odom"])
        other.until(lambda: other.of("drivers"))
        served.link.publish("odom", odometry(2.5))
        other.until(lambda: other.of("m"))


def test_small_events_come_all_and_in_order(served):
    with Browser(served.port) as page:
        page.send("want", keys=["log/mapper"])
        page.until(lambda: served.link.keys)
        for i in range(50):
            served.link.publish("log/mapper", LogLine(i, "INFO", str(i)))
        page.until(lambda: len(page.of("m")) == 50)
        assert [decode(LogLine, f["b"])[0].text for f in page.of("m")] == [str(i) for i in range(50)]


def test_a_page_that_does_not_read_gets_the_latest_later_and_holds_up_no_other(served):
    scan = LaserScan(1, 0.0, 0.0001, 0.1, 0.1, 30.0, np.zeros(20_000, np.float32), np.zeros(20_000, np.float32))
    with Browser(served.port) as quick, Browser(served.port, read=False, max_queue=1) as slow:
        for page in (quick, slow):
            page.send("want", keys=["odom", "scan"])
        quick.until(lambda: len(served.link.keys) == 2)
        quick.until(lambda: len(served.device._hubs.first._pages) == 2)
        for i in range(150):
            served.link.publish("scan", scan)
            served.link.publish("odom", odometry(float(i)))
            n = len(quick.of("m"))
            quick.until(lambda n=n: len(quick.of("m")) > n)
        slow._thread.start()

        def newest() -> bool:
            xs = [decode(Odometry, f["b"])[0].odom_from_base.x for f in slow.of("m") if f["k"] == "odom"]
            return bool(xs) and xs[-1] == 149.0

        slow.until(newest)
        assert len([f for f in slow.of("m") if f["k"] == "odom"]) < 120, "it got the newest, not all"


def test_a_page_that_said_goodbye_and_reads_no_more_does_not_disturb_the_end(served):
    scan = LaserScan(1, 0.0, 0.0001, 0.1, 0.1, 30.0, np.zeros(20_000, np.float32), np.zeros(20_000, np.float32))
    with Browser(served.port) as page, closing(socket.create_connection(("127.0.0.1", served.port), SOON)) as leaving:
        leaving.sendall(
            b"GET /ws HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )
        assert b"101" in leaving.recv(1000)
        want = msgpack.packb({"t": "want", "keys": ["scan"]})
        leaving.sendall(bytes([0x82, 0x80 | len(want), 0, 0, 0, 0]) + want)  # masked with zeros
        pages = served.device._hubs.first._pages
        page.until(lambda: "scan" in served.link.keys)
        for _ in range(100):  # more than the sockets between the two hold
            served.link.publish("scan", scan)
            page.ask("ask", op="maps")
        leaving.sendall(bytes([0x88, 0x80, 0, 0, 0, 0]))
        page.until(lambda: len(pages) == 1)
        served.device.close()
        page.until(lambda: page.closed)
        assert page.closed[0] == 1012


def test_another_tool_that_drives_is_shown(served):
    with Browser(served.port) as page:
        page.first("hello")
        served.link.on_teleop()
        page.until(lambda: any(f["other"] for f in page.of("drivers")))
        page.until(lambda: not page.of("drivers")[-1]["other"])


def test_the_map_comes_whole_in_parts_and_then_by_its_changes(served):
    places = [(i, j) for i in range(10) for j in range(10)]
    with Browser(served.port) as page:
        page.send("want", keys=["map"])
        page.until(lambda: served.link.keys)
        served.link.publish("map", tiles(5, places, 0), latched=True)
        page.until(lambda: sum(len(f["rows"]) for f in page.of("tiles")) == 100)
        frames = page.of("tiles")
        assert all(len(f["rows"]) <= 64 and len(f["cells"]) == 4096 * len(f["rows"]) for f in frames)
        assert [f["reset"] for f in frames if f["rows"]] == [True, False]
        for value in range(1, 40):
            served.link.publish("map", tiles(5, [(3, 4)], value))
        page.until(lambda: page.of("tiles")[-1]["cells"][:1] == bytes([39]))
        changes = page.of("tiles")[len(frames) :]
        assert len(changes) < 10, "changes are coalesced"
        assert {(tuple(f["rows"]), tuple(f["columns"])) for f in changes} == {((3,), (4,))}
        served.link.publish("map", tiles(6, [(0, 0)], 100))
        page.until(lambda: page.of("tiles")[-1]["reset"])
        assert page.of("tiles")[-1]["rows"] == [0]


def test_a_tool_that_is_missing_or_dies_is_a_refusal(monkeypatch):
    with serving(monkeypatch, tools="json.tool") as served, Browser(served.port) as page:
        reply = page.ask("do", op="maps")
        assert (reply["accepted"], "ended" in reply["detail"]) == (False, True)


def test_a_taken_port_is_the_services_state_until_it_is_free(monkeypatch):
    monkeypatch.setattr("services.dashboard.web.AGAIN_S", 0.05)
    with serving(monkeypatch) as first, serving_on(monkeypatch, first.port) as second:
        assert "in use" in second.core.state()
        first.device.close()
        limit = threading.Event()
        for _ in range(400):
            if second.core.is_open:
                break
            limit.wait(0.05)
        assert second.core.is_open


def serving_on(monkeypatch, port: int):
    monkeypatch.setattr("tests.unit.services.dashboard.browser.DEVICE", f"web://127.0.0.1:{port}")
    return serving(monkeypatch)


def test_the_service_loads_the_web_library_only_with_a_browser():
    import subprocess

    code = "import sys, services.dashboard.web; sys.stdout.write(' '.join(sys.modules))"
    loaded = set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.split())
    assert "services.dashboard.web" in loaded
    assert not loaded & {"starlette", "uvicorn", "anyio", "websockets"}
