# SPDX-License-Identifier: Apache-2.0
"""What commands share: how they are parsed, and the options that several take."""

import os
import re
import sys
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

NEGATIVE = re.compile(r"-\.?\d")
MAX_SHORT_HELP = 120  # characters of a command's line in the list

MAIN, DRIVE, LOOK, FILES = "Start", "Drive", "Look", "Logs, recordings, measurements"


class Command(TyperCommand):
    """A command that takes negative numbers for arguments, not for options, and whose reader may leave.

    Where it has `--robot`, it has `--name` too: its function gets both in `robot`, as NAME@KIND (shared/config.py).
    Without a default, `--robot` is the recorded robot, which has a name.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.help = _with_whole_examples(self.help)
        given = {option: i for i, param in enumerate(self.params) for option in param.opts}
        if "--robot" in given and "--name" not in given and self.params[given["--robot"]].default:
            after = 1 + given["--robot"]
            self.params = [*self.params[:after], _own_name(), *self.params[after:]]  # typer keeps the first list

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        # a number may begin with a space, an option may not
        rest = super().parse_args(ctx, [f" {a}" if NEGATIVE.match(a) else a for a in args])
        name = ctx.params.pop("robot_name", "")
        if name:
            from shared.robot_files import own_name_and_kind

            ctx.params["robot"] = f"{name}@{own_name_and_kind(ctx.params['robot'])[1]}"
        return rest

    def invoke(self, ctx: Any) -> Any:
        try:
            try:
                return super().invoke(ctx)
            finally:
                sys.stdout.flush()
        except BrokenPipeError:  # `zenav topic echo scan | head`: the reader has gone; typer would make it status 1
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0


@cache
def _own_name() -> Any:
    """The option `--name`, as typer makes it of a function."""
    lone = typer.Typer(add_completion=False)

    @lone.command()
    def named(
        robot_name: Annotated[
            str,
            typer.Option(
                "--name",
                envvar="ZENAV_NAME",
                help="Which one, of several robots of a kind; without it: robot.name of the file.",
                show_default=False,
            ),
        ] = "",
    ) -> None: ...

    return typer.main.get_command(lone).params[0]


class Group(TyperGroup):
    """Commands that take negative numbers, and a hint for a mistyped one.

    The help is click's: typer's own imports rich, which takes longer than all else.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.help = _with_whole_examples(self.help)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Lists the commands by their panels, in the order in which these were first named."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for name, command in self.commands.items():
            if not command.hidden:
                panel = getattr(command, "rich_help_panel", None)
                rows = panels.setdefault(panel if isinstance(panel, str) else "Commands", [])
                rows.append((name, command.get_short_help_str(MAX_SHORT_HELP)))
        for panel, rows in panels.items():
            with formatter.section(panel):
                formatter.write_dl(rows)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            commands = self.list_commands(ctx)
            close = get_close_matches(args[0], commands, n=1, cutoff=0.5)
            hint = f"did you mean `{close[0]}`?" if close else f"known: {', '.join(commands)}"
            complain(f"{args[0]} is not a command of {ctx.command_path}", hint)
        return super().resolve_command(ctx, args)


def _with_whole_examples(text: str | None) -> str | None:
    """Marks paragraphs with an example, so that click breaks no line of them: they are to be copied."""
    return text and re.sub(r"\n\n(?=Examples?: )", "\n\n\b\n", text)


def group(text: str) -> typer.Typer:
    return typer.Typer(cls=Group, help=text, no_args_is_help=True, rich_markup_mode=None)


app = group(
    "A navigation stack for wheeled robots. Distances are in m, times in s, angles on this command line in degrees.\n\n"
    "Examples: zenav demo; zenav up --world office; zenav goto 3.5 -1.2 90; zenav topic echo pose"
)


def _keys() -> list[str]:
    from shared.topics import KEYS

    return list(KEYS)


def complete_robot() -> list[str]:
    from shared.robot_files import robot_files

    return sorted(robot_files())


def _worlds() -> list[str]:
    folder = Path(__file__).resolve().parents[2] / "services" / "sim" / "worlds"
    return sorted(path.stem for path in folder.glob("*.yaml"))


RobotName = Annotated[
    str,
    typer.Option(
        "--robot",
        envvar="ZENAV_ROBOT",
        help="Name of a robot (see `zenav robots`), or a YAML file.",
        autocompletion=complete_robot,
    ),
]


Stack = Annotated[
    str,
    typer.Option(
        "--stack", envvar="ZENAV_STACK", help="Number of the stack on this host, or a router: tcp/router:7447."
    ),
]


Simulated = Literal["messages", "emulated"]


World = Annotated[
    str,
    typer.Option(
        help="Simulate this world: empty, room, corridor, office, a YAML file, or barn:N.",
        autocompletion=_worlds,
    ),
]


def _with_packages(given: str) -> str:
    """Begins this command again with other packages than those of the environment, which the registry has."""
    from shared.extensions import VARIABLE, extension_services, packages, topic_modules

    names = tuple(name for name in given.split(",") if name)
    if names and names != packages():
        extension_services(names)
        topic_modules(names)
        os.environ[VARIABLE] = ",".join(names)  # noqa: TID251  # a child's environment is made here
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    return given


With = Annotated[
    str,
    typer.Option(
        "--with",
        envvar="ZENAV_WITH",
        help="Installed packages with services of your own: see docs/new_service.md.",
        metavar="PACKAGE,..",
        callback=_with_packages,
    ),
]

Setting = Annotated[
    list[str] | None, typer.Option("--set", metavar="SECTION.KEY=VALUE", help="Override a setting; may be repeated.")
]


Json = Annotated[bool, typer.Option("--json", help="JSON, one object a line.")]


Key = Annotated[str, typer.Argument(help="Topic, like scan or health/mapper.", autocompletion=_keys)]


Seconds = Annotated[float, typer.Option(min=0.1, help="s")]


Out = Annotated[Path | None, typer.Option("--out", help="JSON file for the results.")]


At = Annotated[
    tuple[float, float, float] | None,
    typer.Option(metavar="X Y DEG", help="Where the robot stands on the map, roughly; without it: found by driving."),
]


MapName = Annotated[
    str,
    typer.Option(
        "--map", envvar="ZENAV_MAP", help="The saved map whose places or zones are meant; without it: those in maps/."
    ),
]


SavedMapMode = Annotated[
    Literal["localise", "continue"], typer.Option(help="Leave the map as it is, or go on mapping.")
]


Registrar = Annotated[
    Literal["line", "kiss"],
    typer.Option(help="Scan alignment: point to line (ours), or the kiss-icp package."),
]


Write = Annotated[bool, typer.Option("--write", help="Put the result into the robot's file.")]


Yes = Annotated[bool, typer.Option("--yes", help="Do not ask before the robot moves.")]


TopicScan = Annotated[str, typer.Option(help="Of a bag: the laser's topic; without it: the best by type.")]


TopicOdom = Annotated[str, typer.Option(help="Of a bag: odometry's topic; without it: the best by type, or tf.")]


BaseFrame = Annotated[str, typer.Option(help="Of a bag: the robot's frame; without it: odometry's child frame.")]


OdomFrame = Annotated[str, typer.Option(help="Of a bag: odometry's frame in tf; without it: found by its name.")]


RecordingFile = Annotated[Path, typer.Argument(help="Recording.", metavar="FILE.mcap")]


Recordings = Annotated[list[Path], typer.Argument(help="Recordings.", metavar="FILE.mcap...")]


NewRecording = Annotated[Path, typer.Option("--out", help="The new recording.", metavar="OUT.mcap")]


Begin = Annotated[float | None, typer.Option(min=0, help="s since its start.")]


End = Annotated[float | None, typer.Option(min=0, help="s since its start.")]


Seeds = Annotated[str, typer.Option(help="Like 3, 0-9 or 0,4,7-9.")]


def complain(what: str, hint: str) -> NoReturn:
    sys.stderr.write(f"{what}\nhint: {hint}\n")
    raise typer.Exit(2)
