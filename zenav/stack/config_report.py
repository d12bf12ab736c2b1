# SPDX-License-Identifier: Apache-2.0
"""`zenav config`: the values in force, where each comes from, and what is wrong with a robot's file."""

import sys
from collections.abc import Iterator, Mapping
from typing import Any

from shared.config import Robot, RobotFile, Section, UserError, configured, nearest
from shared.topics import SERVICES


def section_models(names: tuple[str, ...] | None = None) -> dict[str, type[Section]]:
    """Section -> model, of the robot and of every service that exists here (or of the named ones)."""
    from zenav.stack.service_loader import existing_services, service_class

    wanted = [name for name in existing_services() if names is None or name in names]
    return {"robot": Robot} | {name: service_class(name).config_type for name in wanted}


def read_sections(file: RobotFile, names: tuple[str, ...] | None = None) -> dict[str, Section]:
    """Every section of a robot's file, read. Raises UserError on the first fault, also an unknown section."""
    file.unknown_sections(("robot", *SERVICES))
    sections = {name: file.section(name, model) for name, model in section_models(names).items()}
    require_one_gyro(file, sections)
    return sections


def require_one_gyro(file: RobotFile, sections: Mapping[str, Section]) -> None:
    """Raises UserError where something beside imu_driver would publish `imu`: only one publisher is admitted."""
    from services.base_driver.boards.models import MODELS_WITH_GYRO
    from services.base_driver.config import BaseDriverConfig
    from services.imu_driver.service import ImuDriverConfig
    from services.ros2.config import Ros2Config

    imu, base, ros2 = (sections.get(name) for name in ("imu_driver", "base_driver", "ros2"))
    if not isinstance(imu, ImuDriverConfig) or not imu.port.given:
        return
    place = f"{file.place(('imu_driver', 'port'))}: imu_driver.port"
    board = base.board if isinstance(base, BaseDriverConfig) and base.port.given else None
    if board is not None and board.model in MODELS_WITH_GYRO and board.gyro:
        raise UserError(
            f"{place}: the board {board.model} publishes `imu`, too",
            "switch off the board's gyro: base_driver.board.gyro: false; or leave out imu_driver.port",
        )
    if isinstance(ros2, Ros2Config) and ros2.drives and ros2.imu:
        raise UserError(f"{place}: ros2 publishes `imu`, too", "leave out ros2.imu, or imu_driver.port")


def check_config(robot: str, settings: list[str]) -> None:
    """Says that a robot's file is valid, or raises UserError."""
    file = configured(robot, settings)
    sections = read_sections(file)
    sys.stdout.write(
        f"{file.path}: valid, {sum(1 for _ in setting_values(sections))} values in {len(sections)} sections\n"
    )


def show_config(robot: str, settings: list[str], only: str, origin: bool) -> None:
    """Writes the values in force as YAML; with `origin`, each with its place."""
    file = configured(robot, settings)
    known = tuple(section_models())
    if only and only not in known:
        raise UserError(f"{only} is not a section", nearest(only, known))
    sections = {name: section for name, section in read_sections(file).items() if only in ("", name)}
    if not origin:
        sys.stdout.write(yaml_of({name: section.model_dump(mode="json") for name, section in sections.items()}))
        return
    rows = [(f"{'.'.join(path)}: {value}", origin_of(file, path)) for path, value in setting_values(sections)]
    width = min(max(len(text) for text, _ in rows), 64)
    for text, place in rows:
        sys.stdout.write(f"{text:<{width}}  # {place}\n")


def setting_values(sections: dict[str, Section]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """(path, value) of every setting; a list is one value."""

    def inside(path: tuple[str, ...], value: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
        if isinstance(value, dict):
            for key, inner in value.items():
                yield from inside((*path, str(key)), inner)
        else:
            yield path, value

    for name, section in sections.items():
        yield from inside((name,), section.model_dump(mode="json"))


def origin_of(file: RobotFile, path: tuple[str, ...]) -> str:
    """Where a value comes from: `--set`, a line of the robot's file, or the default."""
    node: Any = file.tree
    for part in path:
        if not isinstance(node, dict) or part not in node:
            return "default"
        node = node[part]
    return file.place(path)


def yaml_of(tree: dict[str, Any]) -> str:
    """The tree as YAML, lists on one line."""
    from io import StringIO

    from ruamel.yaml import YAML

    yaml, stream = YAML(), StringIO()
    yaml.default_flow_style = None
    yaml.width = 120
    yaml.dump(tree, stream)
    return stream.getvalue()
