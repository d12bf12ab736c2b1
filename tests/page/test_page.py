# SPDX-License-Identifier: Apache-2.0
"""The page in Chromium on a simulated robot: goals, driving by hand, STOP, and what holds when page or server end."""

import os
import signal
from math import atan2, cos, hypot, pi, sin

import pytest

pytest.importorskip("playwright", reason="the page's tests need playwright and Chromium")

from shared import topics
from shared.geometry import wrapped
from shared.messages import GuardState
from tests.page.browser_page import CHROMIUM, PHONE, SHOWS_CELLS, choose, hold_stick, middle, rail

if not CHROMIUM:
    pytest.skip("the page's tests need playwright and Chromium", allow_module_level=True)

MOVED_M = 0.03
STANDS_MPS = 0.005
OBSERVED_NS = 1_500_000_000  # longer than STOP is held for its release, and than the guard takes to brake


def commanded(stack):
    command = stack.client.latest(topics.CMD_VEL)
    return abs(command.v) + abs(command.w)


def truth(stack):
    return stack.client.latest(topics.TRUTH)


def moved(stack, since):
    here, there = truth(stack).world_from_base, since.world_from_base
    return hypot(here.x - there.x, here.y - there.y) > MOVED_M or abs(wrapped(here.yaw - there.yaw)) > 0.1


def stands(stack):
    return commanded(stack) == 0 and abs(truth(stack).v) < STANDS_MPS and abs(truth(stack).w) < 0.02


def drive(stack, page):
    """Holds the stick ahead until the robot has moved."""
    before = truth(stack)
    hold_stick(page)
    stack.until(lambda: commanded(stack) > 0.02 and moved(stack, before))


def test_a_goal_by_press_and_drag_has_the_dragged_heading_and_is_reached(pages, stack):
    page = pages.open()
    pose = stack.client.latest(topics.POSE).map_from_base
    task, before = stack.client.latest(topics.NAV_STATUS).task_id, stack.client.latest(topics.GOAL)
    page.get_by_role("button", name="Follow the robot").click()
    width, height = page.viewport_size["width"], page.viewport_size["height"]
    choose(page, "Goal")
    x, y = width / 2 + 40 * cos(pose.yaw), height / 2 - 40 * sin(pose.yaw)  # 40 px ahead of the robot
    heading = wrapped(pose.yaw + pi / 3)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 90 * cos(heading), y - 90 * sin(heading), steps=4)
    page.mouse.up()

    def active():
        goal = stack.client.latest(topics.GOAL)
        return goal is not None and goal.active and (before is None or goal.id != before.id)

    pages.until(active)
    goal = stack.client.latest(topics.GOAL)
    assert abs(wrapped(goal.map_from_goal.yaw - heading)) < 0.2
    ahead = atan2(goal.map_from_goal.y - pose.y, goal.map_from_goal.x - pose.x)
    assert abs(wrapped(ahead - pose.yaw)) < 0.4
    pages.until(lambda: stack.client.latest(topics.NAV_STATUS).task_id > task)
    pages.until(stack.reached(stack.client.latest(topics.NAV_STATUS).task_id), 60)
    page.locator(".status-headline", has_text="Goal reached").wait_for()
    assert abs(wrapped(stack.client.latest(topics.POSE).map_from_base.yaw - heading)) < goal.yaw_tolerance + 0.1


def test_the_robot_moves_while_the_stick_is_held_and_then_stands(pages, stack):
    page = pages.open()
    drive(stack, page)
    page.locator(".chip", has_text="You drive").wait_for()
    page.mouse.up()
    pages.until(lambda: stands(stack))


def test_a_key_while_which_no_release_is_reported_ends_the_drive(pages, stack):
    page = pages.open()
    drive(stack, page)
    page.keyboard.down("Meta")  # the stick stays held
    pages.until(lambda: stands(stack))


@pytest.mark.parametrize("end", ["page", "context"])
def test_a_page_that_is_closed_while_it_drives_leaves_a_robot_that_stands(pages, stack, end):
    page = pages.open()
    drive(stack, page)
    (page if end == "page" else page.context).close()
    pages.until(lambda: stands(stack))


def test_space_stops_the_release_needs_a_hold_and_the_robot_does_not_move_after_it(pages, stack):
    page = pages.open()
    drive(stack, page)
    states, commands = [], []
    page.keyboard.press("Space")  # the stick stays held
    pages.until(lambda: stack.client.latest(topics.GUARD).state is GuardState.STOPPED and stands(stack))
    page.locator(".stop-state", has_text="Pressed").wait_for()
    stack.client.listen(topics.GUARD, lambda status, _: states.append(status))
    stack.client.listen(topics.CMD_VEL, lambda command, _: commands.append(command))
    release = page.locator(".release-button")
    release.focus()
    page.keyboard.press("Enter")
    observe(pages, states)
    assert {status.state for status in states} == {GuardState.STOPPED}
    page.keyboard.down("Enter")
    release.wait_for(state="detached")
    page.keyboard.up("Enter")
    pages.until(lambda: states[-1].state is not GuardState.STOPPED)
    observe(pages, commands)
    assert {(command.v, command.w) for command in commands} == {(0.0, 0.0)}


def observe(pages, messages):
    """Waits until messages came for a while."""
    n = len(messages)
    pages.until(lambda: len(messages) > n and messages[-1].stamp - messages[n].stamp > OBSERVED_NS)


def test_a_second_page_that_drives_reads_who_has_the_robot(pages, stack):
    first, second = pages.open(name="Ada"), pages.open(name="Ben")
    drive(stack, first)
    hold_stick(second)
    second.locator(".notice", has_text="Ada drives").wait_for()
    second.mouse.up()
    first.mouse.up()
    pages.until(lambda: stands(stack))


def test_on_a_phone_all_that_drives_and_stops_is_in_view_and_a_finger_drives(pages, stack):
    page = pages.open(PHONE, has_touch=True, is_mobile=True)
    before = truth(stack)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    for shown in (page.locator(".stop-button"), rail(page, "Drive")):
        box = shown.bounding_box()
        assert min(box["x"], box["y"]) >= 0
        assert box["x"] + box["width"] <= PHONE["width"]
        assert box["y"] + box["height"] <= PHONE["height"]
    rail(page, "Drive").tap()
    x, y = middle(page.locator(".stick"))
    fingers = page.context.new_cdp_session(page)

    def touch(kind, *points):
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x, "y": y} for x, y in points]})

    touch("touchStart", (x, y))
    touch("touchMove", (x + 60, y))  # to the right: it turns
    pages.until(lambda: moved(stack, before))
    touch("touchEnd")
    pages.until(lambda: stands(stack))


def test_a_page_comes_back_by_itself_after_its_server_was_killed(pages, stack):
    page = pages.open()
    tiles = []

    def note(frame):
        tiles.extend([frame] if b"tiles" in frame[:16] else [])

    page.on("websocket", lambda socket: socket.on("framereceived", note))
    os.kill(stack.pid("dashboard"), signal.SIGKILL)
    pages.until(lambda: page.locator(".offline").is_visible())
    pages.until(lambda: page.locator(".offline").is_hidden() and tiles)
    assert page.evaluate(SHOWS_CELLS)
    refused = ("WebSocket connection", "ERR_CONNECTION_REFUSED")  # attempts while there was no server
    assert all(any(words in problem for words in refused) for problem in pages.problems)
    pages.problems.clear()
