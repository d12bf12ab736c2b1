# SPDX-License-Identifier: Apache-2.0
"""The settings in force for pages: value, origin and description of each; and changes of those that may change."""

from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from shared.runners.transport import stack_address
from shared.settings import BY_NAME, RUN_TIME, field_at
from zenav.client import Client
from zenav.console.setting_text import bounds_of, unit_of
from zenav.page.target import PageTarget, Values
from zenav.stack.config_report import origin_of, read_sections, section_models, setting_values
from zenav.stack.runtime_settings import RunningSettings

KINDS: tuple[tuple[Any, str], ...] = ((bool, "switch"), (int, "integer"))
"""Type of a setting: how a page edits it. Others are numbers, or choices."""


def settings(target: PageTarget, values: Values) -> list[Values]:
    """Each setting of the robot and of every service, by its name: `guard.field.stop_margin`.

    One that may change while its service runs has its kind, bounds, unit and the value of the start, too.
    """
    file = target.file()
    sections, models = read_sections(file), section_models()
    with Client(file.robot.name, stack_address(target.stack)) as client:
        held = RunningSettings(client, file).held()
    rows = []
    for path, configured in setting_values(sections):
        name, field = ".".join(path), field_at(models[path[0]], path[1:])
        running = held.get(name)
        is_set = running is not None and running.value != running.started
        row = {
            "name": name,
            "value": configured if running is None else running.value,
            "origin": RUN_TIME if is_set else origin_of(file, path),
            "description": field.description or "",
        }
        rows.append(row if running is None else row | {"started": running.started} | editor_of(name, field))
    return rows


def set_setting(target: PageTarget, values: Values) -> str:
    """Changes one setting of the running stack; an empty value: back to that of its start. Returns what changed."""
    file = target.file()
    with Client(file.robot.name, stack_address(target.stack)) as client:
        return RunningSettings(client, file).change({values["name"]: values["value"]})[0]


def editor_of(name: str, field: FieldInfo) -> dict[str, Any]:
    """What a page needs to edit a setting: kind, choices, bounds, unit, and whether it is a limit."""
    choices = list(get_args(field.annotation)) if get_origin(field.annotation) is Literal else []
    bounds = bounds_of(field)
    return {
        "kind": "choice" if choices else next((kind for type_, kind in KINDS if field.annotation is type_), "number"),
        "choices": choices,
        "low": bounds.low,
        "high": bounds.high,
        "unit": unit_of(field),
        "is_limit": BY_NAME[name].is_limit,
    }
