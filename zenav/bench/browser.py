# SPDX-License-Identifier: Apache-2.0
"""`zenav bench browser`: the page in Chromium with a map of 4032 x 4032 cells; its frames and its memory.

The page's server is a process as `zenav up` starts it, and the robot is messages (published_robot.py). Meanwhile the
mouse drags the map and the wheel zooms it, from the whole map to some pixels a cell and back.
"""

import math
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from services.dashboard.address import BASE_PORT
from shared.config import UserError, load_robot
from shared.messages import TILE_CELLS
from shared.runners.client import Client
from shared.runners.transport import StackAddress
from zenav.bench.listener import wait_for_listener
from zenav.bench.published_robot import PublishedRobot
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table
from zenav.stack.launch import free_stack

TILES = (5, 63)  # of the maps, each way: 320 and 4032 cells
MIN_FRAMES_PER_S, MAX_PSS_MB = 30.0, 200.0
VIEWPORT = {"width": 1440, "height": 900}
LOADS_S = 12.0  # that the page has for the map
STEP_S = 1 / 60  # between two moves of the mouse
WHEEL_EVERY, WHEEL_PX, ZOOM_S = 4, 120, 2.0  # moves a turn of the wheel; s in one direction
COUNT_FRAMES = """() => {
  window.benchFrames = [];
  const note = (time) => { window.benchFrames.push(time); requestAnimationFrame(note); };
  requestAnimationFrame(note);
}"""
COLUMNS = "map", "frames a second", "longest frame, ms", "script a frame, ms", "PSS, MB", "own, MB", "RSS, MB"
BROWSERS = "chromium", "chromium-browser", "google-chrome"


def browser(out: Path | None, seconds: float) -> int:
    """`zenav bench browser`; 0 when the limits are kept. Raises UserError where there is no browser."""
    check_writable(out)
    name = load_robot("x80sv").robot.name
    with (
        opened_chromium() as chromium,
        free_stack() as claim,
        page_server(claim.where) as url,
        Client(name, claim.where) as client,
    ):
        rows = {"an empty page": measured_page(chromium, "about:blank", None, seconds)}
        for tiles in TILES:
            cells = tiles * TILE_CELLS
            rows[f"{cells} x {cells}"] = measured_page(chromium, url, PublishedRobot(client, tiles), seconds)
    report = figures(rows)
    _show(report)
    write_report(out, report)
    return 0 if report["kept"] else 1


def figures(rows: dict[str, dict[str, float]]) -> dict[str, Any]:
    """The report. The limits apply to the last row, the largest map's."""
    last = list(rows.values())[-1]
    kept = last["frames_per_s"] >= MIN_FRAMES_PER_S and last["pss_mb"] <= MAX_PSS_MB
    return {"rows": rows, "min_frames_per_s": MIN_FRAMES_PER_S, "max_pss_mb": MAX_PSS_MB, "kept": kept}


def measured_page(
    chromium: Any, url: str, robot: PublishedRobot | None, seconds: float, loads_s: float = LOADS_S
) -> dict[str, float]:
    """Frames and memory of a page while its map is moved. loads_s: until anything is measured."""
    context = chromium.new_context(viewport=VIEWPORT)
    try:
        page = context.new_page()
        page.goto(url)
        with robot or nullcontext():
            page.wait_for_timeout(loads_s * 1e3)
            if robot is not None:
                page.get_by_role("button", name="Whole map").click()
            devtools = context.new_cdp_session(page)
            devtools.send("Performance.enable")
            page.evaluate(COUNT_FRAMES)
            before = _script_s(devtools)
            _look_around(page, seconds)
            frames = np.diff(np.asarray(page.evaluate("window.benchFrames"), float))
            script = _script_s(devtools) - before
            memory = _renderer(chromium).memory_full_info()
    finally:
        context.close()
    return {
        "frames_per_s": 1e3 / float(frames.mean()),
        "longest_ms": float(frames.max()),
        "script_ms": 1e3 * script / len(frames),
        "pss_mb": memory.pss / 1e6,
        "uss_mb": memory.uss / 1e6,
        "rss_mb": memory.rss / 1e6,
    }


def _look_around(page: Any, seconds: float) -> None:
    """Drags the map in circles, and zooms in and out."""
    x, y = VIEWPORT["width"] / 2, VIEWPORT["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    began, n = time.monotonic(), 0
    while (now := time.monotonic() - began) < seconds:
        n += 1
        page.mouse.move(x + 200 * math.sin(3 * now), y + 150 * math.sin(2 * now))
        if n % WHEEL_EVERY == 0:
            page.mouse.wheel(0, -WHEEL_PX if now % (2 * ZOOM_S) < ZOOM_S else WHEEL_PX)
        threading.Event().wait(STEP_S)
    page.mouse.up()


def _renderer(chromium: Any) -> psutil.Process:
    """The page's process. Chromium also keeps a spare one, which has done nothing."""
    found = chromium.new_browser_cdp_session().send("SystemInfo.getProcessInfo")["processInfo"]
    return psutil.Process(max((p for p in found if p["type"] == "renderer"), key=lambda p: p["cpuTime"])["id"])


def _script_s(devtools: Any) -> float:
    metrics = {row["name"]: row["value"] for row in devtools.send("Performance.getMetrics")["metrics"]}
    return float(metrics["ScriptDuration"])


@contextmanager
def opened_chromium() -> Iterator[Any]:
    """A headless browser. Raises UserError where there is none."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise UserError("playwright is not installed", "pip install -r requirements-dev.txt") from None
    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if path is None:
        raise UserError("no Chromium here", "apt install chromium")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=["--disable-gpu"])
        try:
            yield chromium
        finally:
            chromium.close()


@contextmanager
def page_server(where: StackAddress) -> Iterator[str]:
    """The page's server; its address."""
    command = [sys.executable, "-m", "services.dashboard", "--stack", str(where.domain)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    address = f"127.0.0.1:{BASE_PORT + where.domain}"
    try:
        wait_for_listener(address)
        yield f"http://{address}/"
    finally:
        process.terminate()
        process.wait(10)


def _show(report: dict[str, Any]) -> None:
    keys = "frames_per_s", "longest_ms", "script_ms", "pss_mb", "uss_mb", "rss_mb"
    rows = [(name, *(f"{row[key]:.1f}" for key in keys)) for name, row in report["rows"].items()]
    limits = f"at least {MIN_FRAMES_PER_S:.0f} frames a second, at most {MAX_PSS_MB:.0f} MB (PSS)"
    show_table(
        f"the page in Chromium while its map is dragged and zoomed; the last row's limits: {limits}", COLUMNS, rows
    )
