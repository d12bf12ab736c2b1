# SPDX-License-Identifier: Apache-2.0
"""The command line: its commands, and the report of their errors."""

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import errno
import os
import sys
from contextlib import suppress
from typing import Any

import typer

# isort: off
# in the order in which `zenav --help` lists them
from zenav.cli import starting, robots, services, driving, looking, settings, logs  # noqa: F401  # their commands are the app's
from zenav.cli.looking import config, topic
from zenav.cli.robots import robot
from zenav.cli.maps import map_
from zenav.cli.places import places
from zenav.cli.fleets import fleet
from zenav.cli.zones import zones
from zenav.cli.pages import page
from zenav.cli.calibrating import calibrate
from zenav.cli.recordings import recording
from zenav.cli.batches import batch
from zenav.cli.securing import secure
from zenav.cli.sites import site
from zenav.cli.measuring import bench

# isort: on
from zenav.cli.parts import DRIVE, FILES, LOOK, MAIN, app

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
USAGE_ERROR: Any = typer.BadParameter.__base__  # typer's public names have only its descendants

app.add_typer(robot, name="robot", rich_help_panel=MAIN)
app.add_typer(secure, name="secure", rich_help_panel=MAIN)
app.add_typer(topic, name="topic", rich_help_panel=LOOK)
app.add_typer(map_, name="map", rich_help_panel=LOOK)
app.add_typer(places, name="places", rich_help_panel=DRIVE)
app.add_typer(fleet, name="fleet", rich_help_panel=DRIVE)
app.add_typer(site, name="site", rich_help_panel=DRIVE)
app.add_typer(zones, name="zones", rich_help_panel=DRIVE)
app.add_typer(page, name="page", rich_help_panel=LOOK)
app.add_typer(config, name="config", rich_help_panel=LOOK)
app.add_typer(calibrate, name="calibrate", rich_help_panel=DRIVE)
app.add_typer(recording, name="recording", rich_help_panel=FILES)
app.add_typer(batch, name="batch", rich_help_panel=FILES)
app.add_typer(bench, name="bench", rich_help_panel=FILES)


def _status(arguments: list[str] | None) -> int:
    """Runs a command and returns its exit status. An error that the user can fix becomes one line and a hint."""
    try:
        result = app(arguments, standalone_mode=False, prog_name="zenav")
        return result if isinstance(result, int) else 0
    except USAGE_ERROR as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            error.show()
            return 2
        path = error.ctx.command_path if error.ctx else "zenav"
        sys.stderr.write(f"{_one_line(error.format_message())}\nhint: see {path} --help\n")
        return 2
    except typer.Exit as end:
        return end.exit_code
    except SystemExit as end:  # shell completion ends so
        return end.code if isinstance(end.code, int) else 0
    except (typer.Abort, KeyboardInterrupt):
        return 130
    except Exception as error:
        from shared.user_error import UserError

        if isinstance(error, OSError) and error.errno in DISK_FULL:
            place = f": {error.filename}" if error.filename else ""
            error = UserError(f"no space is left on the disk{place}", "make room: see df -h")
        if not isinstance(error, UserError):
            raise
        sys.stderr.write(f"{_one_line(error.what)}\nhint: {_one_line(error.hint)}\n")
        return 2


def _one_line(text: str) -> str:
    return " ".join(text.split())


def main(arguments: list[str] | None = None) -> None:
    """The console script."""
    status = 1
    try:
        status = _status(arguments)
    except Exception:
        import traceback

        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):  # a full disk was reported when it was written to
                stream.flush()
        os._exit(status)  # Zenoh's threads are not daemons: a plain return could hang


if __name__ == "__main__":
    main()
