# SPDX-License-Identifier: Apache-2.0
"""Pictures of the page for the README and docs/page.md, of a stack that explores an office: make screenshots."""

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import sys
import tempfile
from contextlib import chdir
from io import BytesIO
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page

from shared import requests
from shared.requests import Explore
from tests.page.browser_page import CHROMIUM, DESKTOP, PHONE, Pages, chromium
from tests.stack.processes import ALL, running, wait

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
EXPLORES_S = 60.0
DRAWS_MS = 1500  # that the page has for its first pictures
N_COLORS = 128


def write(page: Page, path: Path) -> None:
    """Writes what a page shows, with few colors."""
    page.get_by_role("button", name="Whole map").click()
    page.wait_for_timeout(DRAWS_MS)
    picture = Image.open(BytesIO(page.screenshot())).convert("RGB")
    picture.quantize(N_COLORS, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    """Writes page.png and page_phone.png."""
    if not CHROMIUM:
        sys.exit("no Chromium\nhint: apt install chromium")
    with (
        tempfile.TemporaryDirectory() as folder,
        chdir(folder),
        running(Path(folder, "logs"), (*ALL, "dashboard"), world="office") as stack,
        chromium() as browser,
    ):
        stack.until(lambda: stack.client.ask(requests.EXPLORE, Explore(stack.client.now())).accepted)
        pages = Pages(browser, stack)
        desktop = pages.open(DESKTOP, color_scheme="light")  # before the robot drives off: the page has its trail
        for _ in range(round(EXPLORES_S)):
            wait(1.0)
            stack.launcher.step()
        write(desktop, IMAGES / "page.png")
        write(pages.open(PHONE, color_scheme="dark", has_touch=True, is_mobile=True), IMAGES / "page_phone.png")
        pages.close()


if __name__ == "__main__":
    main()
