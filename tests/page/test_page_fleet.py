# SPDX-License-Identifier: Apache-2.0
"""The page of a site in Chromium: two robots on one map, the list, selection, and STOP for all."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shared import topics
from shared.geometry import Pose2
from shared.grid import update_of_cells
from shared.messages import (
    BaseStatus,
    GuardState,
    GuardStatus,
    Localization,
    MapState,
    NavState,
    NavStatus,
    PoseEstimate,
)
from shared.messages import Path as Plan
from shared.runners import transport
from shared.runners.transport import StackAddress
from tests.page.browser_page import CHROMIUM, DESKTOP, LIMIT_MS, NOTE_VIOLATIONS, SHOWS_CELLS
from tests.stack.test_site import free_port
from zenav.client import Client

if not CHROMIUM:
    pytest.skip("no Chromium on this machine", allow_module_level=True)

LIMIT_S = 60.0


class PublishedRobot:
    """What a robot's link publishes at a site, without the robot: it drives in a circle on the map `hall`."""

    def __init__(self, client: Client, phase: float) -> None:
        self.client, self.phase, self.is_stopped = client, phase, False
        client.listen(topics.ESTOP, lambda order, _: setattr(self, "is_stopped", order.pressed))
        self._map = transport.LatchedPublisher(client.session, f"{client.robot}/map")
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def end(self) -> None:
        self._ending.set()
        self._thread.join()

    def _run(self) -> None:
        began = time.monotonic()
        while not self._ending.wait(0.2):
            self._publish(self.phase + (time.monotonic() - began) / 5)

    def _publish(self, angle: float) -> None:
        now, put = self.client.now(), self.client.publish
        circle = angle + np.linspace(0, 2, 20)
        state = GuardState.STOPPED if self.is_stopped else GuardState.ACTIVE
        put(topics.GUARD(GuardStatus(now, state, "", "estop" if self.is_stopped else "", "", 0.5)), "guard")
        put(topics.MAP_STATE(MapState(now, 0, "hall", ())), "mapper")
        place = Pose2(8 + 4 * np.cos(angle), 6 + 4 * np.sin(angle), angle + np.pi / 2)
        put(topics.POSE(PoseEstimate(now, place, Pose2(), np.zeros(9), 1.0, Localization.GOOD)), "mapper")
        xs, ys = 8 + 4 * np.cos(circle), 6 + 4 * np.sin(circle)
        put(topics.PLAN(Plan(now, 1, 1, "", xs, ys, circle, 8.0, 8.0)), "planner")
        put(topics.BASE_STATUS(BaseStatus(now, 24.3, 0.0, 0.0, True, "", "")), "base_driver")
        status = NavStatus(
            stamp=now, task_id=1, state=NavState.NAVIGATING, recovery="", reason="", detail="", goal=Pose2(),
            distance_left=8.0, time_left=16.0, waypoint=0, n_waypoints=1, n_recoveries=0,
        )  # fmt: skip
        put(topics.NAV_STATUS(status), "navigator")
        cells = np.zeros((60, 80), np.int8)
        cells[[0, -1], :] = cells[:, [0, -1]] = 100
        put(topics.MAP(update_of_cells(cells, 0.2, 0.0, 0.0, now)), "mapper")


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, dict[str, PublishedRobot]]]:
    import zenoh

    router, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    command = [sys.executable, "-m", "services.dashboard", "--stack", router, "--robot", "red@x80sv"]
    for setting in ("dashboard.fleet=true", "dashboard.tools=''", f"dashboard.port.device=web://127.0.0.1:{port}"):
        command += ["--set", setting]
    with ExitStack() as stack:
        stack.enter_context(zenoh.open(transport.router_configuration(router)))
        robots = {}
        for i, name in enumerate(("red", "blue", "green")):
            client = stack.enter_context(Client(name, StackAddress(router=router)))
            robots[name] = PublishedRobot(client, 2.0 * i)
            stack.callback(robots[name].end)
        process = subprocess.Popen(command, cwd=Path(__file__).resolve().parents[2])
        stack.callback(process.wait, 10)
        stack.callback(process.terminate)
        yield f"http://127.0.0.1:{port}/", robots


def until(holds: Callable[[], Any], page: Any) -> None:
    limit = time.monotonic() + LIMIT_S
    while not holds():
        assert time.monotonic() < limit, page.content()[-2000:]
        page.wait_for_timeout(50)


@pytest.fixture
def page(url: tuple[str, Any]) -> Iterator[Any]:
    from playwright.sync_api import Error

    from tests.page.browser_page import chromium

    problems: list[str] = []
    with chromium() as browser:
        context = browser.new_context(viewport=DESKTOP, locale="en-GB")
        context.set_default_timeout(LIMIT_MS)
        context.add_init_script(NOTE_VIOLATIONS)
        page = context.new_page()
        page.on("console", lambda line: problems.append(line.text) if line.type == "error" else None)
        page.on("pageerror", lambda error: problems.append(str(error)))
        limit = time.monotonic() + LIMIT_S
        while True:
            try:
                page.goto(url[0])
                break
            except Error:
                assert time.monotonic() < limit
                page.wait_for_timeout(200)
        problems.clear()  # of the time before the server listened
        yield page
    assert problems == []


def test_the_page_of_a_site_lists_all_robots_shows_them_on_one_map_and_stops_them(page, url):
    _, robots = url
    until(lambda: page.evaluate(SHOWS_CELLS), page)
    page.get_by_role("button", name="Fleet").first.click()
    rows = page.locator(".fleet-list .list-item")
    until(lambda: rows.count() == 3, page)
    assert "24.3 V" in rows.first.inner_text()
    rail = page.locator(".rail")
    assert rail.get_by_role("button", name="Drive").count() == 0, "nothing is driven by hand from a site"
    assert rail.get_by_role("button", name="Maps").count() == 0
    until(lambda: "another map" not in page.locator(".fleet-list").inner_text(), page)
    page.get_by_role("button", name="green", exact=False).first.click()
    page.wait_for_url("**/?robot=green")
    until(lambda: page.title().startswith("green"), page)
    page.get_by_role("button", name="Fleet").first.click()
    until(lambda: rows.count() == 3, page)
    page.get_by_role("button", name="STOP for all").click()
    assert not any(robot.is_stopped for robot in robots.values()), "the first press asks"
    page.get_by_role("button", name="Press again").click()
    until(lambda: all(robot.is_stopped for robot in robots.values()), page)
    until(lambda: page.locator(".fleet-list .fleet-stopped").count() == 3, page)
