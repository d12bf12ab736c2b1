# SPDX-License-Identifier: Apache-2.0
"""Where robot files and pages of the manual lie: in a checkout, and in an installed package. Imports nothing heavy."""

import re
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

ROBOTS_DIR = Path(__file__).resolve().parent / "robots"
"""The built-in robot files: data of this package, real files (numba's cache needs those of the code too)."""
DOCS_DIR = Path(__file__).resolve().parents[1] / "docs"
"""The manual in a checkout; an installed package has it in share/doc/zenav."""

OWN_NAME = re.compile(r"([^/.@]+)@(.+)")
ROBOT_SECTION = re.compile(r"^robot:", re.MULTILINE)


def own_name_and_kind(robot: str) -> tuple[str, str]:
    """The robot's own name and its kind, from `red@x80sv`; without an own name the first one is empty."""
    named = OWN_NAME.fullmatch(robot)
    return (named[1], named[2]) if named else ("", robot)


def robot_files(folder: Path = Path()) -> dict[str, Path]:
    """Robot files by name: the built-in ones, and those of `folder`, which come before built-in ones of their name.

    A YAML file of `folder` is a robot file where it has a section `robot`.
    """
    built_in = {path.stem: path for path in sorted(ROBOTS_DIR.glob("*.yaml"))}
    return built_in | {path.stem: path for path in sorted(folder.glob("*.yaml")) if _is_robot(path)}


def is_installed(path: Path) -> bool:
    """Whether a robot file is one of an installed package, which the next version replaces."""
    return path.resolve().parent == ROBOTS_DIR and not DOCS_DIR.is_dir()


def manual_page(name: str) -> str:
    """The place of a page of the manual, like `configuration.md`, for a hint; its name where it is not installed."""
    if (DOCS_DIR / name).is_file():
        return f"docs/{name}"
    try:
        installed = next((file for file in files("zenav") or () if file.match(f"share/doc/zenav/{name}")), None)
    except PackageNotFoundError:
        installed = None
    return str(Path(str(installed.locate())).resolve()) if installed else f"{name} of zenav's manual"


def _is_robot(path: Path) -> bool:
    try:
        return bool(ROBOT_SECTION.search(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError):
        return False
