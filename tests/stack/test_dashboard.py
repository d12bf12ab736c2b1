# SPDX-License-Identifier: Apache-2.0
"""The page's server as a process of a simulated stack: what a page sees, how it drives, and that it never drives on."""

import os
import signal
from collections.abc import Iterator

import pytest
from mcap.reader import make_reader

from services.dashboard.address import BASE_PORT
from services.dashboard.login_store import LoginStore
from shared import topics
from shared.codec import decode
from shared.messages import GuardState, Health, PoseEstimate, Velocity
from shared.roles import Role
from tests.stack.processes import ROBOT, StackProcesses, assert_replays, running
from tests.unit.services.dashboard.browser import Browser
from tests.unit.services.dashboard.credentials import REMOTE, make_credentials
from tests.unit.services.dashboard.remote import RemoteComputer
from zenav.client import Client

BARE = ("sim", "base_driver", "odometry", "mapper", "guard", "dashboard")


@pytest.fixture(scope="module")
def stack(tmp_path_factory) -> Iterator[StackProcesses]:
    with running(tmp_path_factory.mktemp("dashboard"), BARE) as stack:
        stack.client.follow(topics.CMD_VEL)
        stack.until(lambda: all(stack.client.latest(t) for t in (topics.GUARD, topics.TRUTH, topics.MAP)))
        yield stack


def page_of(stack: StackProcesses) -> Browser:
    return Browser(BASE_PORT + stack.where.domain)


def commanded(stack: StackProcesses, v: float) -> bool:
    command = stack.client.latest(topics.CMD_VEL)
    return command is not None and command.v == pytest.approx(v, abs=0.01)


def drive(stack: StackProcesses, page: Browser) -> None:
    """Drives back, until the guard commands it."""

    def driving() -> bool:
        page.teleop(-0.1)
        return commanded(stack, -0.1)

    stack.until(driving)


def test_a_page_sees_a_simulated_robot_and_its_map(stack):
    with page_of(stack) as page:
        hello = page.first("hello")
        assert (hello["role"], hello["simulated"], hello["robot"]["name"]) == ("admin", True, ROBOT.name)
        page.send("want", keys=["map", "pose", "scan", "guard/status", "health/sim"])
        page.until(lambda: sum(len(frame["rows"]) for frame in page.of("tiles")) > 0)
        page.until(lambda: {f["k"] for f in page.of("m")} == {"pose", "scan", "guard/status", "health/sim"})
        pose = next(f for f in page.of("m") if f["k"] == "pose")
        assert decode(PoseEstimate, pose["b"])[0].map_from_base is not None
    assert stack.healths["dashboard"].bad_messages == 0


def test_a_page_whose_connection_is_cut_drives_no_more(stack):
    with page_of(stack) as page:
        page.first("hello")
        drive(stack, page)
        page.socket.cut()  # no goodbye
        stack.until(lambda: commanded(stack, 0.0))


def test_a_page_that_falls_silent_drives_no_more(stack):
    with page_of(stack) as page:
        page.first("hello")
        drive(stack, page)
        stack.until(lambda: commanded(stack, 0.0))
        page.until(lambda: page.of("drivers")[-1]["driver"] is None)


def test_another_tool_has_the_robot_and_the_page_says_so(stack):
    with page_of(stack) as page, Client(ROBOT.name, stack.where) as keyboard:
        page.first("hello")

        def both() -> bool:
            keyboard.publish(topics.TELEOP(Velocity(keyboard.now(), 0.05, 0.0, "")))
            page.teleop(-0.1)
            return commanded(stack, 0.05)

        stack.until(both)
        page.until(lambda: any("elsewhere" in f["text"] for f in page.of("note")))
        assert any(f["other"] for f in page.of("drivers"))


def test_stop_of_one_page_holds_until_another_releases_it(stack):
    with page_of(stack) as first, page_of(stack) as second:
        for page in (first, second):
            page.first("hello")
        first.send("stop")
        stack.until(lambda: stack.client.latest(topics.GUARD).state is GuardState.STOPPED)
        second.send("release")
        stack.until(lambda: stack.client.latest(topics.GUARD).state is not GuardState.STOPPED)


def test_a_request_reaches_its_service_and_a_service_that_is_missing_is_named(stack):
    with page_of(stack) as page:
        page.first("hello")
        refused = page.ask("ask", request="request/cancel", args={})
        assert (refused["accepted"], refused["reason"]) == (False, "not_running")
        assert "navigator" in refused["detail"]
        assert page.ask("ask", request="request/override", args={"seconds": 0.0})["accepted"]


def test_a_page_stays_open_while_each_service_is_killed_and_shows_the_next_process(stack):
    with page_of(stack) as page:
        page.first("hello")
        names = [name for name in BARE if name != "dashboard"]
        page.send("want", keys=["map", "pose", "scan", *(f"health/{name}" for name in names)])

        def shown_pids(name: str) -> list[int]:
            return [decode(Health, f["b"])[0].pid for f in page.of("m") if f["k"] == f"health/{name}"]

        for name in names:
            page.until(lambda name=name: shown_pids(name))
            before = stack.pid(name)
            os.kill(before, signal.SIGKILL)
            stack.until(lambda name=name, before=before: (shown_pids(name) or [before])[-1] != before)
            assert shown_pids(name)[-1] == stack.pid(name)
        n_frames = len(page.of("m"))
        page.until(lambda: {"pose", "scan"} <= {f["k"] for f in page.of("m")[n_frames:]})
        assert page.closed is None


def test_what_pages_did_replays_to_the_byte_and_a_tool_lists_the_recording(tmp_path):
    path = tmp_path / "page.mcap"
    with running(tmp_path / "logs", ("recorder", *BARE), settings=(f"recorder.file={path}",)) as stack:
        stack.client.follow(topics.CMD_VEL)
        with page_of(stack) as page, page_of(stack) as other:
            page.first("hello")
            page.send("want", keys=["pose", "health/sim"], debug=True)
            drive(stack, page)
            other.teleop(0.1)
            other.until(lambda: any("page 1 drives" in f["text"] for f in other.of("note")))
            other.send("stop")
            stack.until(lambda: stack.client.latest(topics.GUARD).state is GuardState.STOPPED)
            page.socket.send(b"junk")
            page.until(lambda: any("msgpack" in f["text"] for f in page.of("note")))
            (row,) = [row for row in page.ask("do", op="recordings")["data"] if row["name"] == path.name]
            assert row["current"]
    assert_replays(path, "dashboard", ("cmd/teleop", "estop", "port/tx/dashboard"))


def test_a_recording_of_logins_has_name_role_and_audit_no_token_and_replays_to_the_byte(tmp_path, monkeypatch):
    path, secure = tmp_path / "page.mcap", tmp_path / "secure"
    monkeypatch.setenv("ZENAV_SECURE", str(secure))
    store = LoginStore(make_credentials(secure))
    settings = (f"recorder.file={path}", f"dashboard.port.device=web://{REMOTE}")
    secrets = [store.invite("anna", Role.OPERATOR, 15), store.invite("ben", Role.VIEWER, 15)]
    with running(tmp_path / "logs", ("recorder", *BARE), settings=settings) as stack:
        stack.client.follow(topics.CMD_VEL)
        anna, ben = (RemoteComputer(BASE_PORT + stack.where.domain) for _ in range(2))
        assert anna.login("a-wrong-token-of-a-stranger") == 401
        assert [anna.login(secrets[0]), ben.login(secrets[1])] == [200, 200]
        secrets += ["a-wrong-token-of-a-stranger", anna.cookie, ben.cookie]
        with anna.page() as page, ben.page() as other:
            secrets += [shown.first("hello")["csrf"] for shown in (page, other)]
            drive(stack, page)
            other.teleop(-0.1)
            other.until(lambda: any("may not send" in f["text"] for f in other.of("note")))
            store.revoke("anna")
            page.until(lambda: page.closed)
            stack.until(lambda: commanded(stack, 0.0))
            assert ben.request("POST", "/logout", b"", x_csrf=secrets[-1])[0] == 204
            other.until(lambda: other.closed)
    assert_replays(path, "dashboard", ("cmd/teleop", "port/tx/dashboard", "log/dashboard"))
    with path.open("rb") as file:
        recorded = [(channel.topic, message.data) for _, channel, message in make_reader(file).iter_messages()]
        file.seek(0)
        attached = [attachment.data for attachment in make_reader(file).iter_attachments()]
    logged = b"".join(data for key, data in recorded if key.endswith("log/dashboard"))
    for line in (
        f"anna (operator, {REMOTE}): login",
        f"anna (operator, {REMOTE}): teleop begins",
        f"anna (operator, {REMOTE}): teleop ends",
        f"anna (operator, {REMOTE}): the session is revoked",
        f"ben (viewer, {REMOTE}): refused: teleop",
        f"ben (viewer, {REMOTE}): logout",
        f"failed login 1 from {REMOTE}",
    ):
        assert line.encode() in logged, line
    written = [file.read_bytes() for file in (tmp_path / "logs").rglob("*") if file.is_file()]
    whole = b"".join([*(data for _, data in recorded), *attached, *written])
    assert b"anna" in whole
    assert all(secret.encode() not in whole for secret in secrets)
