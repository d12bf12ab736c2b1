# SPDX-License-Identifier: Apache-2.0
"""The page of a stack: its address, the services that it needs, and the browser that is opened once."""

import webbrowser
from types import SimpleNamespace

import pytest

from shared.config import UserError, configured
from shared.messages import Health
from shared.runners.transport import StackAddress
from zenav.stack.hardware import Hardware, services_for
from zenav.stack.page import PageOpener, page_url, with_page

URL = "http://127.0.0.1:8603"


def health(name: str) -> Health:
    return Health(0, name, 1, "", 0, 0, 0, 0, "", 0.0, 0.0, 0.0, ())


def test_the_address_follows_the_stacks_number_and_the_setting():
    assert page_url(configured("x80sv", []), StackAddress(3)) == URL
    named = configured("x80sv", ["dashboard.port.device=web://localhost:9000"])
    assert page_url(named, StackAddress(3)) == "http://127.0.0.1:9000"


def test_an_address_for_other_computers_is_an_error_before_anything_starts():
    open_to_all = configured("x80sv", ["dashboard.port.device=web://0.0.0.0"])
    with pytest.raises(UserError, match=r"own address only") as refused:
        page_url(open_to_all, StackAddress())
    assert "ssh -L" in refused.value.hint


def test_a_whole_stack_has_the_page_only_where_it_is_wanted():
    names = services_for(Hardware.MESSAGES, configured("x80sv", []))
    assert "dashboard" not in names
    assert with_page(names, False) == names
    assert with_page(with_page(names, True), True) == [*names, "dashboard"]


def at_terminal(monkeypatch, terminal: bool) -> None:
    stderr = SimpleNamespace(isatty=lambda: terminal)
    monkeypatch.setattr("zenav.stack.page.sys", SimpleNamespace(stderr=stderr))


@pytest.fixture
def opened(monkeypatch) -> list[str]:
    urls: list[str] = []
    monkeypatch.setattr(webbrowser, "open", urls.append)
    monkeypatch.setattr(
        "zenav.stack.page.threading.Thread", lambda target, args, daemon: SimpleNamespace(start=lambda: target(*args))
    )
    at_terminal(monkeypatch, True)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    return urls


def test_a_browser_is_opened_once_in_a_desktop_session(opened, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    opener = PageOpener(URL, wanted=True)
    for name in ("mapper", "dashboard", "dashboard"):
        opener.hear(health(name))
    assert opened == [URL]


def test_no_browser_is_opened_without_a_display_a_terminal_or_a_wish(opened, monkeypatch):
    PageOpener(URL, wanted=True).hear(health("dashboard"))
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    PageOpener(URL, wanted=False).hear(health("dashboard"))
    at_terminal(monkeypatch, False)
    PageOpener(URL, wanted=True).hear(health("dashboard"))
    assert opened == []
