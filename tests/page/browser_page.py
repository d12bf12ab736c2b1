# SPDX-License-Identifier: Apache-2.0
"""The page in Chromium for tests: pages that note what went wrong in them, and what they show and send."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, BrowserContext, Error, Locator, Page, sync_playwright

from services.dashboard.address import BASE_PORT
from tests.stack.processes import StackProcesses

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), ""
)
DESKTOP = {"width": 1440, "height": 900}
PHONE = {"width": 360, "height": 740}
LIMIT_MS = 20_000  # of one step in a page, on a busy machine
NOTE_VIOLATIONS = """
document.addEventListener("securitypolicyviolation", (event) =>
  console.error(`CSP violation: ${event.violatedDirective} ${event.blockedURI}`));
"""
SHOWS_CELLS = """() => {
  const canvas = document.querySelector(".map-canvas");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const cells = new Uint32Array(data.buffer);
  let n = 0;
  for (let i = 0; i < cells.length; i++) if (cells[i] !== cells[0]) n++;
  return n > cells.length / 50;
}"""
"""Whether at least 2 % of the map's canvas differ from its corner, where nothing is known."""


class Pages:
    """Pages of one stack in one browser. `problems` collects their errors, those of the console too."""

    def __init__(self, browser: Browser, stack: StackProcesses) -> None:
        self.browser, self.stack = browser, stack
        self.url = f"http://127.0.0.1:{BASE_PORT + stack.where.domain}/"
        self.problems: list[str] = []
        self.contexts: list[BrowserContext] = []

    def open(self, viewport: dict[str, int] | None = None, name: str = "", **options: Any) -> Page:
        """A page that is connected and shows the map. name: what other pages call it."""
        context = self.browser.new_context(viewport=viewport or DESKTOP, locale="en-GB", **options)
        context.set_default_timeout(LIMIT_MS)
        context.add_init_script(NOTE_VIOLATIONS)
        if name:
            context.add_init_script(f"localStorage.setItem('zenav.name', '\"{name}\"')")
        self.contexts.append(context)
        page = context.new_page()
        page.on("console", lambda line: self.problems.append(line.text) if line.type == "error" else None)
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.goto(self.url)
        self.until(lambda: page.evaluate(SHOWS_CELLS))
        return page

    def until(self, holds: Callable[[], object], seconds: float = 30.0) -> None:
        """Waits while the stack and the pages go on."""
        self.stack.until(holds, seconds)

    def close(self) -> None:
        for context in self.contexts:
            with suppress(Error):
                context.close()
        self.contexts.clear()


@contextmanager
def chromium() -> Iterator[Browser]:
    """A headless Chromium."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--disable-gpu"])
        try:
            yield browser
        finally:
            browser.close()


def middle(locator: Locator) -> tuple[float, float]:
    """The middle of an element, px of the viewport."""
    box = locator.bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def rail(page: Page, name: str) -> Locator:
    """A button of the rail."""
    return page.locator(".rail-item", has_text=name)


def hold_stick(page: Page, dx: float = 0.0, dy: float = -60.0) -> None:
    """Turns Drive on, presses the stick and pulls it by (dx, dy) px: ahead unless said. It stays held."""
    rail(page, "Drive").click()
    x, y = middle(page.locator(".stick"))
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + dx, y + dy)


def choose(page: Page, tool: str) -> None:
    """Chooses a tool that draws on the map."""
    page.locator(".tool", has_text=tool).click()


def download(page: Page, link: Locator, folder: Path) -> Path:
    """What a link downloads."""
    with page.expect_download() as started:
        link.click()
    path = folder / started.value.suggested_filename
    started.value.save_as(path)
    return path
