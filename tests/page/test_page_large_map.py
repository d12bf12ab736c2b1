# SPDX-License-Identifier: Apache-2.0
"""The page with a map of 4032 x 4032 cells: it shows all of it, and its process stays small."""

import pytest

pytest.importorskip("playwright", reason="the page's tests need playwright and Chromium")

from tests.page.browser_page import CHROMIUM
from zenav.bench.browser import MAX_PSS_MB, TILES, measured_page, opened_chromium, page_server
from zenav.bench.published_robot import PublishedRobot
from zenav.client import Client
from zenav.stack.launch import free_stack

if not CHROMIUM:
    pytest.skip("the page's tests need playwright and Chromium", allow_module_level=True)

IS_KNOWN = """(share) => {
  const canvas = document.querySelector(".map-canvas");
  const shown = Math.min(canvas.width, canvas.height);
  const side = Math.round(shown / 2 * share);
  const [x, y] = [Math.round(canvas.width / 2), Math.round(canvas.height / 2)];
  const context = canvas.getContext("2d");
  const background = context.getImageData(0, 0, 1, 1).data.join();
  const isMap = ([dx, dy]) => {
    const { data } = context.getImageData(x + dx * side - 3, y + dy * side - 3, 7, 7);
    for (let i = 0; i < data.length; i += 4) if (data.slice(i, i + 4).join() !== background) return true;
    return false;
  };
  return [[-1, -1], [-1, 1], [1, -1], [1, 1]].every(isMap);
}"""
"""Whether a square around the middle of the canvas has the map at its corners. share: its side, of the canvas."""


def test_a_large_map_is_shown_to_its_corners_and_needs_little_memory():
    with opened_chromium() as chromium, free_stack() as claim, page_server(claim.where) as url:
        context = chromium.new_context(viewport={"width": 1440, "height": 900})
        with Client("x80", claim.where) as client:
            page = context.new_page()
            page.goto(url)
            with PublishedRobot(client, TILES[-1]):
                button = page.get_by_role("button", name="Whole map")
                for _ in range(60):
                    button.click()
                    page.wait_for_timeout(500)
                    if page.evaluate(IS_KNOWN, 0.6):
                        break
                assert page.evaluate(IS_KNOWN, 0.6)
                assert not page.evaluate(IS_KNOWN, 0.9), "the whole map is in view"
            context.close()
            measured = measured_page(chromium, url, PublishedRobot(client, TILES[-1]), 4.0, 5.0)
    assert measured["pss_mb"] <= MAX_PSS_MB
    assert measured["frames_per_s"] > 0
