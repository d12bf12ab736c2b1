# SPDX-License-Identifier: Apache-2.0
"""`zenav robots` lists robot files; `zenav robot new` writes one into the current folder, to be edited."""

import re
import sys
from pathlib import Path

from shared.config import Robot, RobotFile, UserError, load_robot
from shared.robot_files import ROBOTS_DIR, manual_page, robot_files

ROBOT_NAME = re.compile(r"[a-z][a-z0-9_]*")
"""As `Robot.name` of shared/config.py allows."""

HEADER = """\
# {name}, from {source}: edit this file until it describes your robot.
#
# Measure footprint, wheels and the laser's mount; every setting is in {manual}
# Check it:   zenav config check --robot {name}
# Run it:     zenav up --robot {name}          in this folder; elsewhere --robot PATH/{name}.yaml
# Calibrate:  zenav calibrate motors --robot {name} --write; it keeps these comments
#
# The file that it was made from begins below.
"""


def list_robots() -> None:
    """Shows each robot that `--robot NAME` finds here: its name, what it is, and where its file lies."""
    rows = [(name, description(path), _place(path)) for name, path in sorted(robot_files().items())]
    widths = [max(len(row[i]) for row in rows) for i in range(2)]
    for name, about, place in rows:
        sys.stdout.write(f"{name:<{widths[0]}}  {about:<{widths[1]}}  {place}\n")


def description(path: Path) -> str:
    """The first sentence of a robot file that begins with a comment; else the robot's name in it."""
    text = path.read_text(encoding="utf-8")
    first = text.partition("\n")[0]
    if first.startswith("#"):
        return first.lstrip("# ").partition(". ")[0].rstrip(" .")
    name = re.search(r"^ +name: *(\S+)", text, re.MULTILINE)
    return name[1] if name else ""


def new_robot(name: str, source: str, folder: Path) -> Path:
    """Writes folder/NAME.yaml, a copy of a robot's file with its comments and with `name` as the robot's name.

    source: a robot by name or path.  Returns the file's path.
    Raises UserError where the name is not valid, the file exists, or it cannot be written.
    """
    if not ROBOT_NAME.fullmatch(name):
        raise UserError(f"invalid robot name {name!r}", "small letters, digits and underscores, like my_robot")
    origin = load_robot(source)
    header = HEADER.format(name=name, source=source, manual=manual_page("configuration.md"))
    text = header + renamed(origin, name)
    path = folder / f"{name}.yaml"
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise UserError(f"{path} exists", "take another name, or move that file away") from None
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}", "run it from a folder of yours") from None
    return path


def renamed(file: RobotFile, name: str) -> str:
    """The text of a robot's file with `robot.name` replaced and nothing else changed. Raises UserError on a fault."""
    file.section("robot", Robot)  # a faulty file is not copied
    lines = file.path.read_text(encoding="utf-8").splitlines(keepends=True)
    i, column = file.tree["robot"].lc.value("name")
    lines[i] = lines[i][:column] + re.sub(r"^\S+", name, lines[i][column:])
    return "".join(lines)


def _place(path: Path) -> str:
    if path.parent.resolve() == ROBOTS_DIR:
        return "built in"
    return f"here: {path}" + ", in the place of the built-in one" * (ROBOTS_DIR / path.name).is_file()
