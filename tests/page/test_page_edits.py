# SPDX-License-Identifier: Apache-2.0
"""The page in Chromium: virtual walls and erased areas are drawn, listed and undone, and the map has a name."""

import pytest

pytest.importorskip("playwright", reason="the page's tests need playwright and Chromium")

from shared import topics
from tests.page.browser_page import CHROMIUM, PHONE, choose, rail

if not CHROMIUM:
    pytest.skip("the page's tests need playwright and Chromium", allow_module_level=True)

FIRST, SECOND = (900, 300), (1000, 400)  # px, in the room, beside what stands above the map


def drag(page, *points):
    page.mouse.move(*points[0])
    page.mouse.down()
    for point in points[1:]:
        page.mouse.move(*point, steps=8)
    page.mouse.up()


def edits(stack):
    state = stack.client.latest(topics.MAP_STATE)
    return [(edit.kind, len(edit.xs)) for edit in state.edits] if state is not None else []


def test_a_wall_and_an_erased_area_are_drawn_listed_and_undone(pages, stack):
    stack.client.follow(topics.MAP_STATE)
    page = pages.open()
    choose(page, "Wall")
    drag(page, FIRST, SECOND)
    pages.until(lambda: edits(stack) == [("wall", 2)])
    (wall,) = stack.client.latest(topics.MAP_STATE).edits
    assert wall.width == 0.1
    right, down = wall.xs[1] - wall.xs[0], wall.ys[0] - wall.ys[1]
    assert right == pytest.approx(down, rel=0.02)
    assert right > 0.5
    choose(page, "Erase")
    drag(page, FIRST, (1000, 300), SECOND)
    pages.until(lambda: len(edits(stack)) == 2)
    assert edits(stack)[1][1] > 4, "a stroke follows the pointer"
    rail(page, "Maps").click()
    page.locator(".list-row", has_text="Virtual wall 1").wait_for()
    page.locator(".list-row", has_text="Erased area 2").wait_for()
    page.locator(".panel").get_by_role("button", name="Undo").click()
    pages.until(lambda: edits(stack) == [("wall", 2)])
    page.get_by_role("button", name="Delete Virtual wall 1").click()
    pages.until(lambda: edits(stack) == [])
    page.locator(".list-row", has_text="Virtual wall").wait_for(state="detached")


def test_the_map_in_use_has_the_name_that_it_was_saved_under_and_places_belong_to_it(pages, stack):
    page = pages.open()
    rail(page, "Maps").click()
    page.get_by_text("Not saved yet · Mapping").wait_for()
    page.get_by_label("Save as").fill("attic")
    page.get_by_role("button", name="Save", exact=True).click()
    page.locator(".list-item", has_text="attic").get_by_text("in use · ").wait_for()
    choose(page, "Place")
    page.mouse.click(*SECOND)
    page.get_by_label("Name of the place").fill("desk")
    page.locator(".draft").get_by_role("button", name="Save").click()
    page.locator(".list-row", has_text="desk").get_by_text("attic").wait_for()


def test_a_finger_draws_a_wall_on_a_phone(pages, stack):
    stack.client.follow(topics.MAP_STATE)
    page = pages.open(PHONE, has_touch=True)
    choose(page, "Wall")
    device = page.context.new_cdp_session(page)
    for kind, at in (
        ("touchStart", (120, 260)),
        ("touchMove", (200, 330)),
        ("touchMove", (220, 350)),
        ("touchEnd", None),
    ):
        points = [{"x": at[0], "y": at[1]}] if at is not None else []
        device.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    pages.until(lambda: edits(stack) == [("wall", 2)])
    page.locator(".tool-hint").get_by_role("button", name="Undo").click()
    pages.until(lambda: edits(stack) == [])
