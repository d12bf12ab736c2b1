# SPDX-License-Identifier: Apache-2.0
"""The stack that a page's tool works on, from its command line."""

import argparse
from dataclasses import dataclass
from typing import Any

from shared.config import RobotFile, configured

Values = dict[str, Any]
"""Arguments of an operation, as the page's server has checked them (services/dashboard/frames.py)."""


@dataclass(frozen=True, slots=True)
class PageTarget:
    """Robot, stack and settings, as the page's server itself was started with them."""

    robot: str
    stack: str
    settings: tuple[str, ...] = ()

    @classmethod
    def of(cls, arguments: list[str]) -> "PageTarget":
        """The target of a command line."""
        parser = argparse.ArgumentParser(prog="zenav.page.tools")
        parser.add_argument("--robot", default="x80sv")
        parser.add_argument("--stack", default="0")
        parser.add_argument("--set", action="append", default=[])
        options = parser.parse_args(arguments)
        return cls(options.robot, options.stack, tuple(options.set))

    def file(self) -> RobotFile:
        """The robot's file with the settings. Raises UserError."""
        return configured(self.robot, list(self.settings))
