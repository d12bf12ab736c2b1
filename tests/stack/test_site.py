# SPDX-License-Identifier: Apache-2.0
"""A robot's link to a site, as processes over TLS: what crosses, what does not, and what a lost link changes."""

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh

from services.gateway.router_process import RouterProcess
from shared import requests, topics
from shared.codec import Envelope, decode, encode
from shared.config import UserError
from shared.credentials import Credentials, parsed_credentials
from shared.geometry import Pose2
from shared.messages import GuardState, GuardStatus, Health, LaserScan, NavState, NavStatus, RobotIntent
from shared.requests import Cancel, Navigate, Reply
from shared.runners import transport
from shared.runners.fleet_listener import FleetListener
from shared.runners.transport import StackAddress
from shared.secure_folder import MemberRole, SecureFolder
from tests.unit.services.traffic.intents import intent
from zenav.client import Client
from zenav.fleet.commands import stop_robots
from zenav.fleet.site_recordings import MARK, fetch_recording, list_robot_recordings
from zenav.fleet.site_router import event_text
from zenav.secure import members
from zenav.stack.launch import free_stack

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 60.0
NOT_S = 1.0  # for which what must not come does not


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def until(holds: Callable[[], object], seen: object = "") -> None:
    limit = time.monotonic() + LIMIT_S
    while not holds():
        assert time.monotonic() < limit, seen
        threading.Event().wait(0.05)


class Site:
    """A router of a site; robots and people become members of its folder."""

    def __init__(self, folder: Path) -> None:
        self.place, self.lines = SecureFolder(folder / "site"), list[str]()
        members.init_folder("plant@x80sv", str(self.place.path), [])
        self.listen, self.local = f"tls/127.0.0.1:{free_port()}", f"tcp/127.0.0.1:{free_port()}"
        self._process: RouterProcess | None = None

    def member(self, name: str, role: MemberRole) -> Path:
        out = self.place.path.with_name(f"{name}.pem")
        members.add_member(name, role, str(self.place.path), out, 10)
        return out

    def credentials(self, name: str, role: MemberRole) -> Credentials:
        return parsed_credentials(self.member(name, role).read_text(), name)

    def start(self) -> None:
        names = {member.common_name: member for member in self.place.members()}
        order = {"local": self.local, "listen": self.listen, "folder": str(self.place.path)}
        self._process = RouterProcess(order, lambda line: self.lines.append(event_text(line, names)))

    def end(self) -> None:
        if self._process is not None:
            self._process.end()
        self._process = None

    def session(self, credentials: Credentials | None = None) -> zenoh.Session:
        return transport.opened(
            StackAddress(router=self.listen if credentials else self.local, credentials=credentials)
        )


class FakeRobot:
    """A stack with the link alone; this test acts as guard and navigator."""

    def __init__(self, name: str, client: Client) -> None:
        self.name, self.client = name, client
        self.stops: list[bool] = []
        self.goals: list[Navigate] = []
        self.health: Health | None = None
        self.lines: list[str] = []
        self.guard_state, self._n = GuardState.IDLE, 0
        self._ending = threading.Event()
        client.listen(topics.ESTOP, lambda order, _: self._stop(order.pressed))
        client.listen(topics.HEALTH, lambda health, _: self._hear(health))
        client.listen(topics.LOG, lambda line, _: self.lines.append(line.text))
        self._queryable = client.session.declare_queryable(f"{name}/request/navigate", self._navigate)
        self._thread = threading.Thread(target=self._publish, daemon=True)
        self._thread.start()

    @property
    def is_linked(self) -> bool:
        return self.health is not None and self.health.state.startswith("linked")

    def end(self) -> None:
        self._ending.set()
        self._thread.join()

    def scan(self) -> None:
        """Publishes a scan of many beams, which no compression makes short."""
        ranges = np.random.default_rng(self.client.now()).uniform(1, 5, 2000).astype(np.float32)
        self.client.publish(
            topics.SCAN(LaserScan(self.client.now(), 0.0, 0.003, 0.1, 0.1, 6.0, ranges)), "lidar_driver"
        )

    def _stop(self, pressed: bool) -> None:
        self.stops.append(pressed)
        self.guard_state = GuardState.STOPPED if pressed else GuardState.IDLE

    def _hear(self, health: Health) -> None:
        self.health = health

    def _navigate(self, query: zenoh.Query) -> None:
        with query:
            goal, _ = decode(Navigate, query.payload.to_bytes())
            self.goals.append(goal)
            reply = Reply(self.client.now(), True, "", "", len(self.goals))
            query.reply(query.key_expr, encode(reply, Envelope("navigator", "n", 0, self.client.now())))

    def _publish(self) -> None:
        while not self._ending.wait(0.1):
            now = self.client.now()
            self.client.publish(topics.GUARD(GuardStatus(now, self.guard_state, "", "", "", 1.0)), "guard")
            status = NavStatus(
                stamp=now, task_id=1, state=NavState.IDLE, recovery="", reason="", detail="", goal=Pose2(),
                distance_left=0.0, time_left=0.0, waypoint=0, n_waypoints=0, n_recoveries=0,
            )  # fmt: skip
            self.client.publish(topics.NAV_STATUS(status), "navigator")


@contextmanager
def linked_robot(site: Site, name: str, credentials: Path) -> Iterator[FakeRobot]:
    with ExitStack() as stack:
        claim = stack.enter_context(free_stack())
        settings = (f"uplink.port.device=tls://{site.listen.removeprefix('tls/')}", f"uplink.credentials={credentials}")
        command = [sys.executable, "-m", "services.uplink", "--stack", str(claim.where.domain)]
        command += ["--robot", f"{name}@x80sv", *(word for setting in settings for word in ("--set", setting))]
        client = stack.enter_context(Client(name, claim.where))
        process = subprocess.Popen(command, cwd=ROOT)
        robot = FakeRobot(name, client)
        try:
            yield robot
        finally:
            robot.end()
            process.terminate()
            assert process.wait(10) == 0, "the link did not end"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp("site"))
    yield site
    site.end()


@pytest.fixture(scope="module")
def red(site: Site) -> Iterator[FakeRobot]:
    credentials = site.member("red", MemberRole.ROBOT)
    site.start()
    with linked_robot(site, "red", credentials) as robot:
        until(lambda: robot.is_linked, robot.lines)
        yield robot


def test_the_tools_of_a_fleet_work_at_the_site(site, red, capsys):
    with FleetListener([site.local]) as fleet:
        (view,) = fleet.hear(LIMIT_S, lambda views: any(view.latest(topics.NAV_STATUS) for view in views))
        fleet.ask_addresses()
        assert view.name == "red"
        assert view.row(time.monotonic()).state in ("idle", "stopped")
        assert len(view.addresses) == 1
    with Client("red", StackAddress(router=site.local)) as client:
        reply = client.ask(requests.NAVIGATE, Navigate(client.now(), (Pose2(1, 2, 0),), 0.0, 1, True))
        assert (reply.accepted, reply.task_id) == (True, 1)
        old = Navigate(client.now(), (Pose2(9, 9, 0),), 0.0, 1, True)
        payload = encode(old, Envelope("operator", "s", 0, client.now() - 3600 * 10**9))
        late, _ = decode(Reply, client.ask_raw(requests.NAVIGATE, payload, 5.0))
        assert (late.accepted, late.reason) == (False, "expired")
    assert [goal.poses[0].x for goal in red.goals] == [1.0]
    assert stop_robots([site.local], ["red"], False) == 0
    assert red.stops[-1] is True
    assert any("audit: site: zenav fleet stop: STOP" in line for line in red.lines)


def test_a_robot_cannot_speak_for_another_and_members_do_what_their_role_may(site, red):
    heard: list[str] = []
    with site.session() as local:
        local.declare_subscriber("**", lambda sample: heard.append(str(sample.key_expr)))
        with site.session(parsed_credentials((site.place.path.parent / "red.pem").read_text(), "red")) as forger:
            for key in ("blue/pose", "red/cmd/vel", "red/estop", "blue/estop"):
                forger.put(key, b"forged")
            forger.put("red/pose", b"its own")
            until(lambda: "red/pose" in heard, heard)
            assert not list(forger.get("red/request/navigate", payload=b"", timeout=NOT_S)), "a robot asks nothing"
    assert not {"blue/pose", "red/cmd/vel", "red/estop", "blue/estop"} & set(heard)
    n = len(red.stops)
    site.end()
    viewer, operator = (site.credentials(role.value, role) for role in (MemberRole.VIEWER, MemberRole.OPERATOR))
    site.start()
    until(lambda: opens(site, viewer), site.lines)
    for who, may in ((viewer, False), (operator, True)):
        with site.session(who) as session:
            seen: list[str] = []
            session.declare_subscriber("red/nav/status", lambda sample, seen=seen: seen.append(str(sample.key_expr)))
            until(lambda seen=seen: seen, site.lines)
            payload = encode(Cancel(0), Envelope("operator", "s", 0, 0))  # long ago: the robot itself refuses it
            replies = list(session.get("red/request/cancel", payload=payload, timeout=20.0))
            assert any(reply.ok is not None for reply in replies) == may
            session.put("red/cmd/teleop", b"by hand")
            assert len(red.stops) == n


def opens(site: Site, credentials: Credentials) -> bool:
    try:
        site.session(credentials).close()
    except UserError:
        return False
    return True


def test_a_link_that_was_lost_comes_back_without_a_burst_and_without_an_order(site, red):
    site.end()
    until(lambda: red.health and "lost" in red.health.state, red.lines)
    n_stops, n_goals = len(red.stops), len(red.goals)
    site.start()
    until(lambda: red.is_linked, red.lines)
    times: list[float] = []
    with site.session() as local:
        local.declare_subscriber("red/nav/status", lambda sample: times.append(time.monotonic()))
        until(lambda: len(times) >= 3, red.lines)
    assert max(sum(t <= other < t + 0.9 for other in times) for t in times) <= 2, "the newest alone is sent"
    assert (len(red.stops), len(red.goals)) == (n_stops, n_goals)


def test_robots_of_one_site_hear_the_intents_of_each_other_and_no_echo_of_their_own(site, red):
    credentials = site.member("blue", MemberRole.ROBOT)
    site.end()
    site.start()
    with linked_robot(site, "blue", credentials) as blue:
        until(lambda: red.is_linked and blue.is_linked, (red.lines, blue.lines))
        heard: dict[str, list[tuple[str, bytes]]] = {robot.name: [] for robot in (red, blue)}
        for robot in (red, blue):
            robot.client.session.declare_subscriber(
                "*/traffic/intent",
                lambda sample, name=robot.name: heard[name].append((str(sample.key_expr), sample.payload.to_bytes())),
            )

        def both_hear() -> bool:
            for robot, at in ((red, 1.0), (blue, 2.0)):
                robot.client.publish(topics.INTENT(intent(robot.client.now(), robot.name, Pose2(at, 0, 0))), "traffic")
            return all(any(key != f"{name}/traffic/intent" for key, _ in found) for name, found in heard.items())

        until(both_hear, heard)
        message, envelope = decode(RobotIntent, next(data for key, data in heard["blue"] if key.startswith("red/")))
        assert (message.robot, message.map_from_base.x, envelope.publisher) == ("red", 1.0, "traffic")
        own = [data for key, data in heard["blue"] if key.startswith("blue/")]
        assert {decode(RobotIntent, data)[1].session for data in own} == {blue.client.session_name}, "no echo"


def test_what_was_recorded_while_the_link_was_lost_is_fetched_afterwards(site, red, tmp_path, capsys):
    folder, out = tmp_path / "robot", tmp_path / "site"
    command = [
        sys.executable,
        "-m",
        "services.recorder",
        "--stack",
        str(red.client.where.domain),
        "--robot",
        "red@x80sv",
    ]
    site.end()
    recorder = subprocess.Popen([*command, "--set", f"recorder.folder={folder}"], cwd=ROOT)
    try:
        until(lambda: red.scan() or any(file.stat().st_size > 100_000 for file in folder.glob("*.mcap")), red.lines)
        site.start()
        until(lambda: red.is_linked, red.lines)
        until(lambda: list_robot_recordings("red", site.local) == 0, red.lines)
    finally:
        recorder.terminate()
        recorder.wait(10)
    (file,) = folder.glob("*.mcap")
    assert file.name in capsys.readouterr().out
    recorder = subprocess.Popen([*command, "--set", f"recorder.folder={folder}"], cwd=ROOT)  # the next start
    try:
        until(lambda: len(list(folder.glob("*.mcap"))) == 2, red.lines)
        (grows,) = set(folder.glob("*.mcap")) - {file}
        assert fetch_recording("red", grows.name, out, site.local) == 0
        assert (out / f"{grows.name}{MARK}").exists()
        assert not (out / grows.name).exists(), "it is not whole"
        (out / f"{file.name}{MARK}").write_bytes(file.read_bytes()[:70_000])  # of a fetch that was interrupted
        assert fetch_recording("red", file.name, out, site.local) == 0
    finally:
        recorder.terminate()
        recorder.wait(10)
    assert (out / file.name).read_bytes() == file.read_bytes()


def test_a_second_robot_of_the_name_is_refused_with_both_places_and_the_first_goes_on(site, red):
    credentials = site.place.path.parent / "red.pem"
    with linked_robot(site, "red", credentials) as twin:
        until(lambda: twin.health and "is a robot named red already, and" in twin.health.state, twin.lines)
        assert not twin.is_linked
        assert red.is_linked


def test_the_credentials_of_another_robot_are_an_error_with_a_hint(site, red, tmp_path):
    command = [sys.executable, "-m", "services.uplink", "--stack", "150", "--robot", "blue@x80sv"]
    command += ["--set", "uplink.port.device=tls://127.0.0.1:1", "--set"]
    done = subprocess.run(
        [*command, f"uplink.credentials={site.place.path.parent / 'red.pem'}"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "the credentials are of red (robot), and this robot is blue" in done.stderr
    assert "hint: at the site: zenav secure add blue --role robot" in done.stderr
    assert "Traceback" not in done.stderr
