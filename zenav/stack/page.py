# SPDX-License-Identifier: Apache-2.0
"""The page of a stack: its address, and a browser that shows it in a desktop session."""

import os
import sys
import threading
import webbrowser

from services.dashboard.address import page_address
from services.dashboard.config import DashboardConfig
from shared.config import RobotFile
from shared.messages import Health
from shared.runners.transport import StackAddress

SERVICE = "dashboard"


def with_page(names: list[str], page: bool) -> list[str]:
    """The names of services, with the page's server where it is wanted."""
    return [*names, SERVICE] if page and SERVICE not in names else names


def page_url(file: RobotFile, where: StackAddress) -> str:
    """The address of the page for a browser. Raises UserError where it is none, or lacks a certificate."""
    return page_address(file.section(SERVICE, DashboardConfig), where).url


def host_settings(host: str) -> list[str]:
    """The setting that serves the page at a host (name or IP address); none for an empty host."""
    return [f"dashboard.port.device=web://{f'[{host}]' if ':' in host else host}"] if host else []


class PageOpener:
    """Opens a browser once, with the first health of the page's server. wanted: whether the user wants one."""

    def __init__(self, url: str, wanted: bool) -> None:
        self._url = url
        self._due = wanted and is_desktop()

    def hear(self, health: Health) -> None:
        """Takes the health of any service, from any thread."""
        if self._due and health.name == SERVICE:
            self._due = False
            threading.Thread(target=webbrowser.open, args=(self._url,), daemon=True).start()


def is_desktop() -> bool:
    """Whether a user sits at a terminal of a desktop session here."""
    display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))  # noqa: TID251  # the session's
    return display and sys.stderr.isatty()
