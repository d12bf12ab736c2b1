# SPDX-License-Identifier: Apache-2.0
"""The commands of `zenav`. A group that is asked for by its name is imported alone: all together take 50 ms."""

from functools import cache
from importlib import import_module

import typer

from zenav.cli.parts import DRIVE, FILES, LOOK, MAIN, app, group

SINGLE = ("starting", "robots", "services", "driving", "looking", "settings", "logs")
"""modules whose commands stand alone, in the order in which `zenav --help` lists them."""
GROUPS = {
    "robot": ("robots", "robot", MAIN),
    "secure": ("securing", "secure", MAIN),
    "topic": ("looking", "topic", LOOK),
    "map": ("maps", "map_", LOOK),
    "places": ("places", "places", DRIVE),
    "fleet": ("fleets", "fleet", DRIVE),
    "site": ("sites", "site", DRIVE),
    "zones": ("zones", "zones", DRIVE),
    "page": ("pages", "page", LOOK),
    "config": ("looking", "config", LOOK),
    "calibrate": ("calibrating", "calibrate", DRIVE),
    "recording": ("recordings", "recording", FILES),
    "batch": ("batches", "batch", FILES),
    "bench": ("measuring", "bench", FILES),
}
"""module, variable and panel of each group by its name."""


def commands_for(first: str) -> typer.Typer:
    """The commands among which a command line that begins with the word `first` finds its own."""
    return _one_group(first) if first in GROUPS else all_commands()


@cache
def all_commands() -> typer.Typer:
    """Every command of `zenav`."""
    for module in SINGLE:
        import_module(f"zenav.cli.{module}")
    for name in GROUPS:
        _add(app, name)
    return app


def _one_group(name: str) -> typer.Typer:
    lone = group("")
    _add(lone, name)
    return lone


def _add(parent: typer.Typer, name: str) -> None:
    module, variable, panel = GROUPS[name]
    parent.add_typer(getattr(import_module(f"zenav.cli.{module}"), variable), name=name, rich_help_panel=panel)
