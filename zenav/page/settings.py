# SPDX-License-Identifier: Apache-2.0
"""The settings in force for pages: value, origin and description of each."""

from shared.config import Section
from zenav.page.target import PageTarget, Values
from zenav.stack.config_report import origin_of, read_sections, setting_values


def settings(target: PageTarget, values: Values) -> list[Values]:
    """Each setting of the robot and of every service, by its name: `guard.field.stop_margin`."""
    file = target.file()
    sections = read_sections(file)
    return [
        {
            "name": ".".join(path),
            "value": value,
            "origin": origin_of(file, path),
            "description": description_of(sections[path[0]], path[1:]),
        }
        for path, value in setting_values(sections)
    ]


def description_of(section: Section, path: tuple[str, ...]) -> str:
    """The description of a setting at a path in a section; empty where it has none."""
    found = ""
    node: object = section
    for name in path:
        field = type(node).model_fields.get(name) if isinstance(node, Section) else None
        if field is None:
            break
        found, node = field.description or "", getattr(node, name)
    return found
