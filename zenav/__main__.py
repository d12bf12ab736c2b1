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

from zenav.cli.commands import commands_for

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
USAGE_ERROR: Any = typer.BadParameter.__base__  # typer's public names have only its descendants


def _status(arguments: list[str] | None) -> int:
    """Runs a command and returns its exit status. An error that the user can fix becomes one line and a hint."""
    words = sys.argv[1:] if arguments is None else arguments
    try:
        result = commands_for(words[0] if words else "")(words, standalone_mode=False, prog_name="zenav")
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
