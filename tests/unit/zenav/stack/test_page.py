# SPDX-License-Identifier: Apache-2.0
"""The page of a stack: its address, the services that it needs, and the browser that is opened once."""

import webbrowser
from types import SimpleNamespace

import pytest

from shared.config import UserError, configured
from shared.messages import Health
from shared.runners.transport import StackAddress
from tests.unit.services.dashboard.credentials import make_credentials
from zenav.stack.hardware import Hardware, services_for
from zenav.stack.page import PageOpener, host_settings, page_url, with_page

URL = "http://127.0.0.1:8603"


def health(name: str) -> Health:
    return Health(0, name, 1, "", 0, 0, 0, 0, "", 0.0, 0.0, 0.0, ())


def test_the_address_follows_the_stacks_number_and_the_setting():
    assert page_url(configured("x80sv", []), StackAddress(3)) == URL
    named = configured("x80sv", ["dashboard.port.device=web://localhost:9000"])
    assert page_url(named, StackAddress(3)) == "http://127.0.0.1:9000"


def test_an_address_for_other_computers_is_an_error_before_anything_starts(monkeypatch, tmp_path):
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path))
    open_to_all = configured("x80sv", host_settings("0.0.0.0"))
    with pytest.raises(UserError, match=r"own address only") as refused:
        page_url(open_to_all, StackAddress())
    assert "zenav secure init" in refused.value.hint
    assert "ssh -L" in refused.value.hint


def test_with_a_certificate_the_address_has_a_name_that_leads_other_computers_here(monkeypatch, tmp_path):
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path))
    make_credentials(tmp_path)
    assert page_url(configured("x80sv", host_settings("0.0.0.0")), StackAddress(3)) == "https://robot.local:8603"
    assert page_url(configured("x80sv", host_settings("::")), StackAddress(3)) == "https://robot.local:8603"
    assert page_url(configured("x80sv", host_settings("10.0.0.5")), StackAddress(3)) == "https://10.0.0.5:8603"
    assert page_url(configured("x80sv", host_settings("")), StackAddress(3)) == URL


def test_a_key_that_others_may_read_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path))
    make_credentials(tmp_path).robot_key.chmod(0o644)
    with pytest.raises(UserError, match="others may read") as refused:
        page_url(configured("x80sv", host_settings("0.0.0.0")), StackAddress())
    assert refused.value.hint.startswith("chmod 600")


def test_a_certificate_without_its_key_is_an_error_of_the_settings():
    with pytest.raises(UserError, match="belong together"):
        page_url(configured("x80sv", ["dashboard.certificate=robot.pem"]), StackAddress())


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
