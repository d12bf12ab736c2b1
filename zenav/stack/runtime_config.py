# SPDX-License-Identifier: Apache-2.0
"""`zenav config set`, `get`, `reset`, `list`, `save`: the settings of a running robot, as text."""

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from shared.config import UserError, load_robot, nearest
from shared.runners.transport import stack_address
from shared.settings import BY_NAME, RUN_TIME, RUNTIME_SETTINGS, field_at
from zenav.client import Client
from zenav.console.setting_text import bounds_text
from zenav.stack.config_report import read_sections, setting_values
from zenav.stack.runtime_settings import RunningSettings, runtime_models


def changes_from(arguments: list[str]) -> dict[str, str]:
    """Name -> value from `NAME=VALUE ...` or `NAME VALUE ...`. Raises UserError."""
    words = [word for argument in arguments for word in argument.strip().split("=", 1)]
    if len(words) % 2 or not words:
        raise UserError(f"{words[-1] if words else 'nothing'!r} has no value", "write NAME=VALUE, or NAME VALUE")
    names, values = words[::2], words[1::2]
    if twice := next((name for name in names if names.count(name) > 1), ""):
        raise UserError(f"{twice} is given twice", "give each setting one value")
    if empty := next((name for name, value in zip(names, values, strict=True) if not value.strip()), ""):
        raise UserError(f"{empty} has no value", f"for the value of the start: zenav config reset {empty}")
    return dict(zip(names, (value.strip() for value in values), strict=True))


def set_settings(robot: str, stack: str, arguments: list[str]) -> None:
    """Changes settings of the running stack, all or none, and writes what changed."""
    changes = changes_from(arguments)
    with _running(robot, stack) as settings:
        for text in settings.change(changes):
            sys.stdout.write(f"{text}\n")


def reset_settings(robot: str, stack: str, names: list[str]) -> None:
    """Goes back to the values of the start, of these settings or of all that were set."""
    with _running(robot, stack) as settings:
        wanted = names or [name for name, held in settings.held().items() if held.value != held.started]
        for text in settings.change(dict.fromkeys(wanted, "")) if wanted else ():
            sys.stdout.write(f"{text}\n")
        if not wanted:
            sys.stderr.write("no setting differs from the start\n")


def get_setting(robot: str, stack: str, name: str) -> None:
    """Writes the value that holds: of the running stack, or of the robot's file where it cannot change meanwhile."""
    if name in BY_NAME:
        with _running(robot, stack) as settings:
            held = settings.held([BY_NAME[name]]).get(name)
        if held is None:
            what = f"{' and '.join(BY_NAME[name].services)} not running: {name} has no value"
            raise UserError(what, f"start the stack; or see the file: zenav config show {BY_NAME[name].path[0]}")
        sys.stdout.write(f"{json.dumps(held.value)}\n")
        return
    values = {".".join(path): value for path, value in setting_values(read_sections(load_robot(robot)))}
    if name not in values:
        raise UserError(f"{name} is not a setting", nearest(name, tuple(values)))
    sys.stdout.write(f"{json.dumps(values[name])}\n")


def list_settings(robot: str, stack: str, as_json: bool) -> None:
    """Writes every setting that may change at run time; without a running service the value of the robot's file."""
    file, models = load_robot(robot), runtime_models()
    values = {".".join(path): value for path, value in setting_values(read_sections(file))}
    with _running(robot, stack) as settings:
        held = settings.held()
    if not held:
        sys.stderr.write("no stack runs: these are the values of the robot's file\n")
    for row in RUNTIME_SETTINGS:
        field = field_at(models[row.path[0]], row.path[1:])
        value = held[row.name].value if row.name in held else values[row.name]
        is_set = row.name in held and held[row.name].value != held[row.name].started
        limits = "only lower" if row.is_limit else bounds_text(field)
        if as_json:
            found = {"name": row.name, "value": value, "bounds": limits, "set": is_set, "what": field.description}
            sys.stdout.write(json.dumps(found) + "\n")
        else:
            origin = f"  # {RUN_TIME}, was {json.dumps(held[row.name].started)}" if is_set else ""
            sys.stdout.write(f"{f'{row.name}: {json.dumps(value)}':<56} {limits:<22}{origin}".rstrip() + "\n")


def save_settings(robot: str, stack: str, path: Path) -> None:
    """Writes a new robot's file with the values that hold in the running stack."""
    if path.suffix not in (".yaml", ".yml"):
        raise UserError(f"{path} is no robot's file", "give a name that ends in .yaml")
    if path.exists():
        raise UserError(f"{path} exists", "choose another name: no robot's file is changed")
    with _running(robot, stack) as settings:
        if not settings.held():
            raise UserError("no stack runs: there is nothing to save", "start it: zenav up")
        text = settings.text_with_present_values()
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}", "choose another place") from None
    sys.stdout.write(f"{path}: use it with --robot {path}\n")


@contextmanager
def _running(robot: str, stack: str) -> Iterator[RunningSettings]:
    file = load_robot(robot)
    with Client(file.robot.name, stack_address(stack)) as client:
        yield RunningSettings(client, file)
