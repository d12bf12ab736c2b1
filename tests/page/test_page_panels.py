# SPDX-License-Identifier: Apache-2.0
"""The page in Chromium: zones, saved maps, replays, the keyboard, and what accessibility tools find."""

import re
import shutil
import zipfile
from math import degrees, hypot
from pathlib import Path

import pytest

pytest.importorskip("playwright", reason="the page's tests need playwright and Chromium")

from shared import requests, topics
from shared.codec import decode
from shared.messages import GuardState, MapMode
from shared.recording import Recording
from shared.requests import SetSettings
from tests.page.browser_page import CHROMIUM, PHONE, choose, download, rail

if not CHROMIUM:
    pytest.skip("the page's tests need playwright and Chromium", allow_module_level=True)

AXE = Path(__file__).parents[2] / "web" / "node_modules" / "axe-core" / "axe.min.js"
CORNERS = ((1000, 250), (1100, 250), (1100, 330), (1000, 330))  # px, beside what stands above the map
FOCUS = """() => {
  const style = getComputedStyle(document.activeElement);
  return [document.activeElement.innerText, style.outlineStyle !== "none" && parseFloat(style.outlineWidth) > 0];
}"""
DRIVE = Path(__file__).parents[1] / "replay" / "recordings" / "driving.mcap"
N_KNOWN = """() => {
  const canvas = document.querySelector(".map-canvas");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const cells = new Uint32Array(data.buffer);
  return cells.reduce((n, cell) => n + (cell !== cells[0]), 0);
}"""
"""Pixels of the map's canvas that are not as its corner, where nothing is known."""


def zone_names(stack):
    zones = stack.client.latest(topics.ZONES)
    return [zone.name for zone in zones.zones] if zones is not None else []


def test_a_zone_that_is_drawn_by_clicks_holds_and_is_there_after_a_reload(pages, stack):
    page = pages.open()
    choose(page, "Zone")
    for x, y in CORNERS:
        page.mouse.click(x, y)
    page.get_by_role("button", name="Close the zone").click()
    page.get_by_label("Name of the zone").fill("carpet")
    page.locator(".draft").get_by_role("button", name="Save").click()
    pages.until(lambda: "carpet" in zone_names(stack))
    (zone,) = [zone for zone in stack.client.latest(topics.ZONES).zones if zone.name == "carpet"]
    width, height = zone.xs.max() - zone.xs.min(), zone.ys.max() - zone.ys.min()
    assert len(zone.xs) == 4
    assert width / height == pytest.approx(100 / 80, rel=0.02)
    page.reload()
    rail(page, "Places").click()
    page.locator(".list-row", has_text="carpet").wait_for()
    page.get_by_role("button", name="Delete carpet").click()
    pages.until(lambda: "carpet" not in zone_names(stack))


def test_a_map_is_saved_loaded_downloaded_uploaded_and_deleted(pages, stack, tmp_path):
    page = pages.open()
    rail(page, "Maps").click()
    page.get_by_label("Save as").fill("attic")
    page.get_by_role("button", name="Save", exact=True).click()
    row = page.locator(".list-item", has=page.get_by_text("attic", exact=True))
    row.locator(".expander").click()

    path = download(page, row.get_by_role("link", name="Download"), tmp_path)
    with zipfile.ZipFile(path) as archive:
        assert "attic/map.yaml" in archive.namelist()
        assert archive.testzip() is None

    copy = path.rename(tmp_path / "cellar.zip")
    page.locator("input[type=file]").set_input_files(copy)
    page.get_by_role("button", name="Upload").click()
    page.locator(".list-name", has_text="cellar").wait_for()

    row.get_by_role("button", name="Load", exact=True).click()
    pages.until(lambda: stack.client.latest(topics.POSE).mode is MapMode.LOCALISE)
    page.locator(".notice", has_text="Map loaded").wait_for()

    row.get_by_role("button", name="Delete").click()
    row.get_by_role("button", name="Really delete?").click()
    row.wait_for(state="detached")
    assert page.locator(".list-name").all_inner_texts() == ["cellar"]


def test_tab_reaches_stop_and_every_button_of_the_rail_with_a_visible_focus(pages):
    page = pages.open()
    wanted = {text.strip() for text in page.locator(".rail-item:visible").all_inner_texts()}
    assert len(wanted) >= 9
    focused = {}
    for _ in range(60):
        page.keyboard.press("Tab")
        text, is_visible = page.evaluate(FOCUS)
        focused[text.strip().split("\n")[0]] = is_visible
        if wanted | {"STOP"} <= focused.keys():
            break
    assert {name: focused.get(name) for name in wanted | {"STOP"}} == dict.fromkeys(wanted | {"STOP"}, True)


@pytest.mark.skipif(not AXE.exists(), reason="axe-core is not in web/node_modules")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(pages, scheme):
    for viewport, panels in ((None, ("Task", "Places", "Maps", "Services", "Settings")), (PHONE, ("Task", "Places"))):
        page = pages.open(viewport, color_scheme=scheme)
        page.evaluate(AXE.read_text())
        for panel in panels:
            rail(page, panel).click()
            page.locator(".panel").wait_for()
            found = page.evaluate("() => axe.run()")
            assert len(found["passes"]) > 10, "axe saw the page"
            serious = [row for row in found["violations"] if row["impact"] in ("serious", "critical")]
            assert [(row["id"], [node["html"][:120] for node in row["nodes"]]) for row in serious] == [], panel


def test_an_error_in_the_console_and_a_violation_of_the_policy_are_noticed(pages):
    page = pages.open()
    page.evaluate("console.error('made up')")
    page.evaluate("""() => {
      const script = document.createElement("script");
      script.textContent = "document.title = 'inline'";
      document.body.append(script);
    }""")
    page.evaluate("() => { setTimeout(() => { throw new Error('thrown'); }) }")
    pages.until(lambda: page.title() and len(pages.problems) >= 4)
    assert page.title() != "inline"
    for words in ("made up", "CSP violation: script-src", "thrown"):
        assert any(words in problem for problem in pages.problems), words
    pages.problems.clear()


def test_a_setting_is_changed_while_the_robot_runs_and_goes_back_to_its_value_of_the_start(pages, stack):
    page = pages.open()
    rail(page, "Settings").click()
    page.get_by_label("Filter").fill("clearance_weight")
    row = page.locator(".setting", has_text="planner.cost.clearance_weight")
    row.get_by_label("planner.cost.clearance_weight").fill("7")
    row.get_by_role("button", name="Set").click()
    row.get_by_text("set at run time").wait_for()
    reply = stack.client.ask(requests.SET, SetSettings(stack.client.now(), (), (), True), service="planner")
    assert dict(zip(reply.names, reply.values, strict=True))["planner.cost.clearance_weight"] == "7.0"
    row.get_by_label("planner.cost.clearance_weight").fill("101")
    row.get_by_role("button", name="Set").click()
    assert row.locator(".setting-value").inner_text() == "7", "the browser knows the bounds too"
    row.get_by_role("button", name="Back to 5").click()
    row.get_by_text("set at run time").wait_for(state="detached")
    assert row.locator(".setting-value").inner_text() == "5"


def recorded_pose(seconds):
    """The newest pose, with the newest odometry, at a time of the drive."""
    recording = Recording(DRIVE)
    end = recording.blocks[0].begin + round(seconds * 1e9) + 1
    newest = {entry.key: entry for entry in recording.entries(("pose", "odom"), end=end)}
    pose, _ = decode(topics.POSE.type, newest["pose"].payload)
    odometry, _ = decode(topics.ODOM.type, newest["odom"].payload)
    return pose.map_from_odom @ odometry.odom_from_base


def seek(page, seconds):
    page.get_by_label("Time in the recording").evaluate(
        """(range, t) => {
          range.value = t;
          range.dispatchEvent(new Event("input", { bubbles: true }));
        }""",
        seconds,
    )


def shown_pose(page):
    text = page.locator(".replay-pose").inner_text()
    return [float(number) for number in re.findall(r"-?[\d.]+", text)]


def shows(page, seconds):
    pose, (x, y, yaw) = recorded_pose(seconds), shown_pose(page)
    return hypot(pose.x - x, pose.y - y) < 0.01 and abs(degrees(pose.yaw) - yaw) < 1


def test_a_recording_is_replayed_beside_the_live_robot_which_stop_still_stops(pages, stack):
    Path("recordings").mkdir(exist_ok=True)
    shutil.copy(DRIVE, "recordings/drive.mcap")
    page = pages.open()
    rail(page, "Records").click()
    page.locator(".list-item", has_text="drive.mcap").get_by_role("button", name="Replay").click()
    band = page.get_by_role("region", name="Replay")
    band.get_by_text("Replay of drive.mcap, not live").wait_for()
    assert page.locator(".toolbar, .rail, .panel").count() == 0, "nothing commands the robot"

    seek(page, 1.0)
    pages.until(lambda: shows(page, 1.0))
    assert hypot(recorded_pose(1.0).x - recorded_pose(5.5).x, recorded_pose(1.0).y - recorded_pose(5.5).y) > 0.5
    pages.until(lambda: page.evaluate(N_KNOWN) > 0)
    n_known = page.evaluate(N_KNOWN)
    seek(page, 5.5)
    pages.until(lambda: shows(page, 5.5))
    pages.until(lambda: page.evaluate(N_KNOWN) > n_known)
    page.keyboard.press("Tab")  # away from the map, whose keys move it
    page.get_by_label("Time in the recording").press("ArrowLeft")
    pages.until(lambda: shows(page, 4.5))

    page.get_by_role("button", name="10×").click()
    band.get_by_role("button", name="Play").press("Enter")
    pages.until(lambda: shows(page, 6.0))

    page.keyboard.press("Space")
    pages.until(lambda: stack.client.latest(topics.GUARD).reason == "estop")
    assert stack.client.latest(topics.GUARD).state is GuardState.STOPPED
    assert "STOP" not in page.locator(".status-headline").inner_text(), "the status is the recording's"

    band.get_by_role("button", name="Back to live").click()
    band.wait_for(state="detached")
    rail(page, "Task").wait_for()
    pages.until(lambda: page.locator(".status.tone-stop").count() == 1)


def test_loop_closures_come_when_a_page_shows_them(pages, stack):
    seen = []
    stack.client.listen(topics.GRAPH, lambda graph, _: seen.append(graph))
    page = pages.open()
    page.get_by_role("button", name="Layers").click()
    page.get_by_role("switch", name="Loop closures").click()
    pages.until(lambda: seen)
    assert len(seen[-1].xs) > 0
