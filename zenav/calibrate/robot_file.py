# SPDX-License-Identifier: Apache-2.0
"""What was found, into the robot's YAML: as text to paste, or written in place with its comments and its layout."""

from collections.abc import Iterable, Mapping
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from services.odometry.dead_reckoning import DeadReckoningConfig
from shared.config import LASER_KEYS, Robot, RobotFile, Section, UserError, load_robot, section_of
from shared.robot_files import is_installed, own_name_and_kind
from shared.ros_map import replace_file

Values = Mapping[str, float | int]
"""Setting -> value: {"robot.drive.wheel_distance": 0.2857}."""

SECTIONS: Mapping[str, type[Section]] = {"robot": Robot, "odometry": DeadReckoningConfig}
"""By name, those that a calibration changes."""

INDENTS = ((4, 2), (2, 0))
"""(spaces to a list's items, of which before the dash), as people write them."""


def values_of(sections: Mapping[str, Section], keys: Iterable[str]) -> Values:
    """The values in force of settings like `robot.drive.wheel_radius`, from the configuration's sections."""
    found: dict[str, float | int] = {}
    for key in keys:
        section, *parts = key.split(".")
        node: Any = sections[section]
        for part in parts:
            node = getattr(node, part)
        found[key] = node
    return found


def yaml_snippet(values: Values, before: Values, laser_names: tuple[str, ...] = ()) -> str:
    """The settings as YAML, each with what it was. laser_names: of the list `robot.lasers`, where the file has that."""
    items = {f"robot.{key}": name for key, name in zip(LASER_KEYS, laser_names, strict=False)}
    lines: list[str] = []
    open_: list[str] = []
    for key, value in values.items():
        *sections, name = key.split(".")
        n_same = next((i for i, (a, b) in enumerate(zip(open_, sections)) if a != b), min(len(open_), len(sections)))
        depth = n_same + any(".".join(sections[:i]) in items for i in range(n_same + 1))
        for i in range(n_same, len(sections)):
            item = items.get(".".join(sections[: i + 1]))
            lines.append(f"{'  ' * depth}{sections[i] if item is None else 'lasers'}:")
            depth += 1
            if item is not None:
                lines.append(f"{'  ' * depth}- name: {item}")
                depth += 1
        open_ = sections
        lines.append(f"{'  ' * depth}{name}: {value}  # was {before[key]:.6g}")
    return "".join(f"{line}\n" for line in lines)


def write(robot: str, values: Values) -> Path:
    """Puts the settings into the robot's file, which is replaced whole or not at all, and returns its path.

    Raises UserError where the values are not valid, or the file cannot be written or rewritten without a loss.
    """
    file = load_robot(own_name_and_kind(robot)[1])
    if is_installed(file.path):
        raise UserError(f"{file.path} belongs to the installed package", f"zenav robot new NAME --from {robot}")
    before = file.path.read_text(encoding="utf-8")
    yaml = layout(before, file.tree)
    for key, value in values.items():
        _put(file.tree, key.split("."), value)
    for name in {key.partition(".")[0] for key in values}:
        file.section(name, SECTIONS[name])  # raises where it is not valid
    text = yaml_text(yaml, file.tree)
    again = RobotFile(file.path, YAML(typ="rt").load(text))
    if again.tree != file.tree:
        raise UserError(f"{file.path} cannot be rewritten without a loss", "paste the lines above into it by hand")
    try:
        replace_file(file.path.resolve(), text.encode())
    except OSError as error:
        raise UserError(f"cannot write {file.path}: {error.strerror}", "paste the lines above into it") from None
    return file.path


def layout(text: str, tree: CommentedMap) -> YAML:
    """The writer that gives back this file as it is, or the nearest to it."""
    writers = []
    for sequence, offset in INDENTS:
        yaml = YAML(typ="rt")
        yaml.width, yaml.preserve_quotes = 100_000, True
        yaml.indent(mapping=2, sequence=sequence, offset=offset)
        writers.append(yaml)
    return next((yaml for yaml in writers if yaml_text(yaml, tree) == text), writers[0])


def yaml_text(yaml: YAML, tree: CommentedMap) -> str:
    """The tree as text."""
    stream = StringIO()
    yaml.dump(tree, stream)
    return stream.getvalue()


def _put(tree: CommentedMap, path: list[str], value: float | int) -> None:
    *sections, name = path
    for section in sections:
        if tree.get(section, {}) is None:
            tree[section] = CommentedMap()
        tree = section_of(tree, section)
    if name in tree or not len(tree):
        tree[name] = value
    else:  # beside its kin, not behind the comments that may follow the last key
        i_nearest = max(range(len(tree)), key=lambda i: _alike(name, str(list(tree)[i])))
        tree.insert(i_nearest + 1, name, value)


def _alike(a: str, b: str) -> int:
    return next((i for i, (x, y) in enumerate(zip(a, b)) if x != y), min(len(a), len(b)))
