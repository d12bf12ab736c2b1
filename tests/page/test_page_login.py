# SPDX-License-Identifier: Apache-2.0
"""The page in Chromium over HTTPS: login by a link, what a viewer sees and may not do, and the end of a session."""

from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path

import pytest

pytest.importorskip("playwright", reason="the page's tests need playwright and Chromium")

from playwright.sync_api import BrowserContext

from services.dashboard.address import BASE_PORT
from services.dashboard.login_store import LoginStore
from shared import topics
from shared.messages import GuardState
from shared.roles import Role
from shared.secure_folder import SecureFolder
from tests.page.browser_page import CHROMIUM, DESKTOP, LIMIT_MS, NOTE_VIOLATIONS, SHOWS_CELLS, rail
from tests.stack.processes import StackProcesses, running
from tests.unit.services.dashboard.credentials import make_credentials

if not CHROMIUM:
    pytest.skip("the page's tests need playwright and Chromium", allow_module_level=True)

BARE = ("sim", "base_driver", "odometry", "mapper", "guard", "dashboard")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecureFolder]:
    path = tmp_path_factory.mktemp("secure")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ZENAV_SECURE", str(path))
        yield make_credentials(path)


@pytest.fixture(scope="module")
def stack(folder: SecureFolder, tmp_path_factory: pytest.TempPathFactory) -> Iterator[StackProcesses]:
    """A stack whose page wants a login of this computer's browser too."""
    work: Path = tmp_path_factory.mktemp("work")
    certificate = (f"dashboard.certificate={folder.robot_certificate}", f"dashboard.key={folder.robot_key}")
    with chdir(work), running(work / "logs", BARE, settings=("dashboard.login=always", *certificate)) as stack:
        stack.until(lambda: stack.client.latest(topics.GUARD) and stack.client.latest(topics.MAP))
        yield stack


@pytest.fixture
def context(browser) -> Iterator[BrowserContext]:
    """A browser on another computer: it has no session, and takes the robot's certificate."""
    context = browser.new_context(viewport=DESKTOP, locale="en-GB", ignore_https_errors=True)
    context.set_default_timeout(LIMIT_MS)
    context.add_init_script(NOTE_VIOLATIONS)
    yield context
    context.close()


def test_a_viewer_logs_in_by_a_link_sees_the_map_may_stop_and_nothing_else_until_the_logout(stack, folder, context):
    url = f"https://127.0.0.1:{BASE_PORT + stack.where.domain}/"
    page, problems = context.new_page(), []
    page.on("console", lambda line: problems.append(line.text) if line.type == "error" else None)
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(url)
    page.locator(".login", has_text="invitation").wait_for()
    assert page.locator(".stop-button").count() == 0, "before the login it would stop nothing"
    assert problems != [], "the WebSocket and the session were refused"
    assert all("401" in problem or "Authentication failed" in problem for problem in problems), problems
    problems.clear()

    token = LoginStore(folder).invite("anna", Role.VIEWER, 15)
    page.goto(f"{url}#invite={token}")
    page.locator(".map-overlay").wait_for()
    stack.until(lambda: page.evaluate(SHOWS_CELLS))
    assert page.url == url, "the token is not in the address any more"
    assert page.locator(".login").count() == 0
    (cookie,) = context.cookies()
    assert (cookie["name"], cookie["httpOnly"], cookie["secure"], cookie["sameSite"]) == (
        "__Host-zenav",
        True,
        True,
        "Strict",
    )
    assert page.evaluate("document.cookie") == ""
    assert rail(page, "Drive").is_disabled()
    assert "viewer" in rail(page, "Drive").get_attribute("title")
    assert page.locator(".toolbar").count() == 0
    rail(page, "Task").click()
    page.locator(".role-note", has_text="You are a viewer").wait_for()
    assert page.get_by_role("button", name="Explore").is_disabled()
    page.keyboard.press("Space")
    stack.until(lambda: stack.client.latest(topics.GUARD).state is GuardState.STOPPED)
    page.locator(".stop-state", has_text="Pressed").wait_for()
    assert page.locator(".release-button").is_disabled()

    rail(page, "Settings").click()
    page.locator(".facts-list", has_text="anna (Viewer)").wait_for()
    assert problems == []
    page.get_by_role("button", name="Log out").click()
    page.locator(".login").wait_for()
    assert context.cookies() == []
    page.get_by_label("Link of the invitation").fill(f"{url}#invite={token}")
    page.locator(".login").get_by_role("button", name="Log in").click()
    page.locator(".login", has_text="is used").wait_for()


def test_a_session_that_is_revoked_shows_the_login_and_nothing_of_the_robot(stack, folder, context):
    page = context.new_page()
    token = LoginStore(folder).invite("ben", Role.OPERATOR, 15)
    page.goto(f"https://127.0.0.1:{BASE_PORT + stack.where.domain}/#invite={token}")
    stack.until(lambda: page.evaluate(SHOWS_CELLS))
    assert rail(page, "Drive").is_enabled()
    LoginStore(folder).revoke("ben")
    page.locator(".login").wait_for()
    assert page.locator("canvas").count() == 0
