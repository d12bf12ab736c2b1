# SPDX-License-Identifier: Apache-2.0
"""The command line: what can be asked for, with units and examples. Only parsing; work is imported when it is due."""

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import os
import re
import sys
from collections.abc import Callable
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

NEGATIVE = re.compile(r"-\.?\d")
USAGE_ERROR: Any = typer.BadParameter.__base__  # typer's public names have only its descendants
MAIN, DRIVE, LOOK, FILES = "Start", "Drive", "Look", "Logs, recordings, measurements"


class Command(TyperCommand):
    """A command that takes negative numbers for arguments, not for options, and whose reader may leave."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        # a number may begin with a space, an option may not
        return super().parse_args(ctx, [f" {a}" if NEGATIVE.match(a) else a for a in args])

    def invoke(self, ctx: Any) -> Any:
        try:
            try:
                return super().invoke(ctx)
            finally:
                sys.stdout.flush()
        except BrokenPipeError:  # `zenav topic echo scan | head`: the reader has gone; typer would make it status 1
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0


class Group(TyperGroup):
    """Commands that take negative numbers, and a hint for a mistyped one."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            known = self.list_commands(ctx)
            close = get_close_matches(args[0], known, n=1, cutoff=0.5)
            hint = f"did you mean `{close[0]}`?" if close else f"known: {', '.join(known)}"
            _complain(f"{args[0]} is not a command of {ctx.command_path}", hint)
        return super().resolve_command(ctx, args)


def _group(text: str) -> typer.Typer:
    return typer.Typer(cls=Group, help=text, no_args_is_help=True, rich_markup_mode="rich")


app = _group(
    "A navigation stack for wheeled robots. Distances are in m, times in s, angles on this command line in degrees.\n\n"
    "Examples: zenav demo; zenav up --world office; zenav goto 3.5 -1.2 90; zenav topic echo pose"
)
bench = _group("Measure: a table here, JSON in a file.")
topic = _group("Look at what goes over the wire.")
map_ = _group("Save, load and look at maps.")
config = _group("Look at the configuration.")
recording = _group("Look into recordings; repair, cut and join them.")
calibrate = _group("Measure the robot: wheels, laser mount, motors. A report, a plot, and the YAML to paste.")


def _services() -> list[str]:
    from shared.topics import SERVICES

    return list(SERVICES)


def _formats() -> list[str]:
    from zenav.convert.export import FORMATS

    return list(FORMATS)


def _faults() -> list[str]:
    from services.sim.hardware.faults import Fault

    return list(Fault)


def _keys() -> list[str]:
    from shared.topics import KEYS

    return list(KEYS)


def _names_in(folder: str, but: str = "") -> Callable[[], list[str]]:
    here = Path(__file__).resolve().parent.parent
    return lambda: sorted(p.stem for p in (here / folder).glob("*.yaml") if p.stem != but)


RobotName = Annotated[
    str,
    typer.Option(
        "--robot", envvar="ZENAV_ROBOT", help="Name in config/, or a YAML file.", autocompletion=_names_in("config")
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
        help="Simulate this world: a name in config/worlds, a YAML file, or barn:N.",
        autocompletion=_names_in("config/worlds"),
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
SavedMapMode = Annotated[
    Literal["localise", "continue"], typer.Option(help="Leave the map as it is, or go on mapping.")
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


@app.command(cls=Command, rich_help_panel=MAIN)
def demo(
    headless: Annotated[bool, typer.Option("--headless", help="Plain lines instead of a live table.")] = False,
    seconds: Annotated[float, typer.Option(min=5, help="s: give up after this long.")] = 1800.0,
    seed: Annotated[int, typer.Option(min=0, help="Of noise, slip, people and loose things.")] = 0,
    record: Annotated[
        Path | None, typer.Option(help="Recording; without it: in the run's folder.", metavar="FILE.mcap")
    ] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="In one process on the virtual clock, repeatable.")
    ] = False,
    hardware: Annotated[
        Simulated, typer.Option(help="What the simulator stands behind: its messages, or ports that speak bytes.")
    ] = "messages",
    robot: RobotName = "x80sv",
    world: World = "office",
    set_: Setting = None,
) -> None:
    """Explore an unknown office, then drive to five goals and back.

    Example: zenav demo --headless --seed 3
    """
    from zenav.demo import demo
    from zenav.hardware import Hardware

    chosen = Hardware(hardware)
    raise typer.Exit(demo(robot, world, seed, seconds, headless, record, lockstep, set_ or [], chosen))


@app.command(cls=Command, rich_help_panel=MAIN)
def up(
    robot: RobotName = "x80sv",
    world: World = "",
    hardware: Annotated[
        Simulated | None,
        typer.Option(help="What the simulator stands behind: its messages (default), or ports that speak bytes."),
    ] = None,
    only: Annotated[str, typer.Option(help="Only these services: a,b", metavar="A,B")] = "",
    saved_map: Annotated[
        str, typer.Option("--map", help="Begin on this saved map: a name below maps/, or a folder.", metavar="DIR")
    ] = "",
    mode: SavedMapMode = "localise",
    at: At = None,
    speed: Annotated[float, typer.Option(min=0.01, max=100, help="Simulated seconds in a real one.")] = 1.0,
    stack: Stack = "0",
    set_: Setting = None,
) -> None:
    """Start the services as processes, and bring dead ones back, until Ctrl-C.

    Example: zenav up --world office
    """
    from shared.messages import MapMode
    from zenav.hardware import Hardware
    from zenav.map_modes import OnMap
    from zenav.maps import found
    from zenav.up import up

    up(
        robot,
        world,
        Hardware(hardware) if hardware else None,
        [name for name in only.split(",") if name],
        speed,
        stack,
        set_ or [],
        OnMap(found(saved_map).parent, MapMode(mode), at) if saved_map else None,
    )


@app.command(cls=Command, rich_help_panel=MAIN)
def run(
    service: Annotated[str, typer.Argument(help="Name of the service.", autocompletion=_services)],
    robot: RobotName = "x80sv",
    stack: Stack = "0",
    set_: Setting = None,
    clock: Annotated[str, typer.Option(metavar="EPOCH:SPEED", help="Simulated time: ns, times as fast as real.")] = "",
    log: Annotated[str, typer.Option(help="DEBUG, INFO, WARNING or ERROR.")] = "INFO",
) -> None:
    """Run one service alone in the foreground, against whatever else runs; also under a debugger.

    Example: zenav run mapper --log DEBUG
    """
    from zenav.up import run

    run(service, robot, stack, set_ or [], clock, log)


@app.command(cls=Command, rich_help_panel=DRIVE)
def goto(
    x: Annotated[float, typer.Argument(help="m, on the map.")],
    y: Annotated[float, typer.Argument(help="m, on the map.")],
    yaw: Annotated[
        float | None, typer.Argument(help="Degrees, counter-clockwise; without it any heading will do.")
    ] = None,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Drive to X Y on the map and stop. Ctrl-C cancels the goal.

    Example: zenav goto 3.5 -1.2 90
    """
    from zenav.drive import drive

    raise typer.Exit(drive(robot, stack, [(x, y, yaw)]))


@app.command(cls=Command, rich_help_panel=DRIVE)
def route(
    poses: Annotated[list[str] | None, typer.Argument(metavar="X,Y[,YAW]...", help="m, m, degrees.")] = None,
    loops: Annotated[int, typer.Option(min=0, help="Rounds; 0 is for ever.")] = 1,
    dwell: Annotated[float, typer.Option(min=0, help="s to stand at each pose.")] = 0.0,
    pause: Annotated[bool, typer.Option("--pause", help="Stand, and keep the present task.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a paused task.")] = False,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Drive through poses in order. Ctrl-C cancels the route.

    Example: zenav route 1,0 4,-2,90 0,0 --loops 3 --dwell 5
    """
    from zenav.drive import drive, paused, poses_from

    if pause or resume:
        raise typer.Exit(paused(robot, stack, pause and not resume))
    raise typer.Exit(drive(robot, stack, poses_from(poses or []), dwell, loops))


@app.command(cls=Command, rich_help_panel=DRIVE)
def explore(robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """Explore until no reachable frontier is left. Ctrl-C cancels.

    Example: zenav explore
    """
    from zenav.drive import explore

    raise typer.Exit(explore(robot, stack))


@app.command(cls=Command, rich_help_panel=DRIVE)
def cancel(robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """Drop the present task: the robot stands.

    Example: zenav cancel
    """
    from zenav.drive import cancel

    raise typer.Exit(cancel(robot, stack))


@app.command(cls=Command, rich_help_panel=DRIVE)
def fault(
    name: Annotated[str, typer.Argument(help="What breaks; without it: what can.", autocompletion=_faults)] = "",
    seconds: Annotated[float, typer.Option(min=0, help="s until it is mended; 0: until --mend.")] = 0.0,
    mend: Annotated[bool, typer.Option("--mend", help="Mend it; without a name: all.")] = False,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Break something of the emulated hardware (zenav up --hardware emulated).

    Example: zenav fault unplugged --seconds 5
    """
    from zenav.fault import fault

    raise typer.Exit(fault(robot, stack, name, seconds, mend))


@app.command(cls=Command, rich_help_panel=DRIVE)
def teleop(
    speed: Annotated[float, typer.Option(min=0.01, max=5, help="m/s")] = 0.3,
    turn: Annotated[float, typer.Option(min=1, max=360, help="degrees/s")] = 45.0,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Drive with the keyboard: w a s d or arrows, space stops, q quits.

    Example: zenav teleop --speed 0.2
    """
    from zenav.teleop import teleop

    teleop(robot, stack, speed, turn)


@app.command(cls=Command, rich_help_panel=DRIVE)
def estop(
    release: Annotated[bool, typer.Option("--release", help="Release it; that never moves the robot.")] = False,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Press STOP: the robot stands until somebody releases it.

    Example: zenav estop --release
    """
    from zenav.drive import estop

    raise typer.Exit(estop(robot, stack, not release))


@topic.command("list", cls=Command)
def topic_list(as_json: Json = False) -> None:
    """Every topic: key, type, rate (Hz), who publishes it, what it carries.

    Example: zenav topic list --json
    """
    from zenav.topic import listed

    listed(as_json)


@topic.command(cls=Command)
def echo(
    key: Key,
    once: Annotated[bool, typer.Option("--once", help="One message.")] = False,
    number: Annotated[int, typer.Option("--number", "-n", min=0, help="Messages; 0 is until Ctrl-C.")] = 0,
    as_json: Json = False,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Show the messages on a topic.

    Example: zenav topic echo pose --once
    """
    from zenav.topic import echo

    raise typer.Exit(echo(robot, stack, key, 1 if once else number, as_json))


@topic.command(cls=Command)
def hz(key: Key, seconds: Seconds = 5.0, as_json: Json = False, robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """Measure a topic: rate (Hz), jitter and age (ms), size.

    Example: zenav topic hz scan --seconds 10
    """
    from zenav.topic import measured

    raise typer.Exit(measured(robot, stack, key, seconds, as_json))


@map_.command(cls=Command)
def save(
    place: Annotated[str, typer.Argument(help="Name below maps/, or a folder.")],
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Write the present map: map.pgm + map.yaml (ROS map_server), graph.msgpack to go on from, and map.png.

    Example: zenav map save office
    """
    from zenav.map_modes import save

    save(robot, stack, place)


@map_.command(cls=Command)
def load(
    place: Annotated[str, typer.Argument(help="Name below maps/, a folder, or a map's YAML.")],
    at: At = None,
    mode: SavedMapMode = "localise",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Give a saved map to the mapper, which finds the robot on it.

    Example: zenav map load office --at 2 -1 90
    """
    from shared.messages import MapMode
    from zenav.map_modes import load

    raise typer.Exit(load(robot, stack, place, MapMode(mode), at))


@map_.command(cls=Command)
def new(robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """Begin a new, empty map where the robot is.

    Example: zenav map new
    """
    from shared.messages import MapMode
    from zenav.map_modes import change

    raise typer.Exit(change(robot, stack, MapMode.MAP, None))


@map_.command(cls=Command)
def mode(
    mode: Annotated[Literal["map", "localise"], typer.Argument(help="Go on mapping, or leave the map as it is.")],
    at: At = None,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Go on with the present map in another mode.

    Example: zenav map mode localise
    """
    from shared.messages import MapMode
    from zenav.map_modes import change

    raise typer.Exit(change(robot, stack, MapMode.CONTINUE if mode == "map" else MapMode.LOCALISE, at))


@map_.command(cls=Command)
def show(
    place: Annotated[str, typer.Argument(help="Name, folder or YAML; without it: the map of the running stack.")] = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Show a map in the terminal.

    Example: zenav map show office
    """
    from zenav.maps import show

    show(robot, stack, place)


@map_.command("convert", cls=Command)
def map_convert(
    place: Annotated[str, typer.Argument(help="Name below maps/, a folder, or the YAML of a ROS map_server map.")],
    out: Annotated[Path, typer.Argument(help="Folder for map.yaml and its picture.")],
    mode: Annotated[
        Literal["trinary", "scale", "raw"], typer.Option(help="Free, occupied, unknown; or every percent, in two ways.")
    ] = "trinary",
    negate: Annotated[bool, typer.Option("--negate", help="White is occupied.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite a map that is there.")] = False,
) -> None:
    """Bring a map of ROS map_server into a folder that `zenav map load` takes, or the stack's to map_server.

    Example: zenav map convert ros/office.yaml maps/office
    """
    from zenav.map_convert import convert

    convert(place, out, mode, negate, force)


@config.command("show", cls=Command)
def config_show(
    section: Annotated[str, typer.Argument(help="Only this section.")] = "",
    origin: Annotated[bool, typer.Option("--origin", help="With the place that each value comes from.")] = False,
    robot: RobotName = "x80sv",
    set_: Setting = None,
) -> None:
    """Print the values that are in force, as YAML.

    Example: zenav config show guard --origin
    """
    from zenav.settings import show

    show(robot, set_ or [], section, origin)


@config.command("check", cls=Command)
def config_check(robot: RobotName = "x80sv", set_: Setting = None) -> None:
    """Check a robot's file: every section and every value.

    Example: zenav config check --robot jackal
    """
    from zenav.settings import check

    check(robot, set_ or [])


@calibrate.command("odometry", cls=Command)
def calibrate_odometry(
    recording: Annotated[
        Path | None, typer.Option(help="Of this drive; without it, squares are driven now.", metavar="FILE.mcap")
    ] = None,
    side: Annotated[float, typer.Option(min=0.5, max=20, help="m: the square's side.")] = 2.0,
    runs: Annotated[int, typer.Option(min=1, max=50, help="Squares each way round.")] = 5,
    measured: Annotated[bool, typer.Option("--measured", help="Type where each square ended, by a tape.")] = False,
    truth: Annotated[Literal["scans", "pose", "sim"], typer.Option(help="What tells where it really was.")] = "scans",
    method: Annotated[
        Literal["best", "umbmark", "scans"],
        typer.Option(help="umbmark: by the squares' ends; scans: by the whole way; best: scans where they suffice."),
    ] = "best",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
    write: Write = False,
    yes: Yes = False,
) -> None:
    """Measure the wheels: their radius, its ratio right to left, and their distance (UMBmark: a square both ways).

    Example: zenav calibrate odometry --side 2 --runs 5
    """
    from zenav.calibrate.commands import calibrate_odometry

    raise typer.Exit(calibrate_odometry(robot, stack, recording, side, runs, measured, truth, method, write, yes))


@calibrate.command("laser", cls=Command)
def calibrate_laser(
    recording: Annotated[Path, typer.Argument(help="Of a drive with turns and straight ways.", metavar="FILE.mcap")],
    robot: RobotName = "x80sv",
    write: Write = False,
) -> None:
    """Measure where the laser sits and looks, from a recording of scan and base/wheels.

    Example: zenav calibrate laser recordings/x80.mcap
    """
    from zenav.calibrate.commands import calibrate_laser

    raise typer.Exit(calibrate_laser(robot, recording, write))


@calibrate.command("motors", cls=Command)
def calibrate_motors(
    blocks: Annotated[
        bool, typer.Option("--blocks", help="The wheels are in the air: no driving, no braking.")
    ] = False,
    speed: Annotated[
        float | None, typer.Option(min=0.1, max=5, help="m/s that it brakes from; without it, the robot's fastest.")
    ] = None,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
    write: Write = False,
    yes: Yes = False,
) -> None:
    """Try the motors: directions, dead band, answer to steps, braking distance.

    Example: zenav calibrate motors --blocks
    """
    from zenav.calibrate.commands import calibrate_motors

    raise typer.Exit(calibrate_motors(robot, stack, blocks, speed, write, yes))


@app.command(cls=Command, rich_help_panel=LOOK)
def doctor(stack: Stack = "0") -> None:
    """What is wrong on this machine, and how to mend it.

    Example: zenav doctor
    """
    from zenav.doctor import doctor

    raise typer.Exit(doctor(stack))


@app.command(cls=Command, rich_help_panel=LOOK)
def foxglove(
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free one.")] = 8765,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0: every network.")] = "127.0.0.1",
    layout: Annotated[bool, typer.Option("--layout", help="Write the layout for the app to stdout, and end.")] = False,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Show the running stack in Foxglove or Lichtblick, and take goals and driving from there, until Ctrl-C.

    Example: zenav foxglove --layout > layout.json; zenav foxglove
    """
    if layout:
        from zenav.foxglove.layout import layout as text

        sys.stdout.write(text())
        return
    from zenav.foxglove.server import serve

    serve(robot, stack, host, port)


@app.command(cls=Command, rich_help_panel=FILES)
def slam(
    log: Annotated[Path, typer.Argument(help="CARMEN log, ROS 1 or 2 bag (file or folder), or recording.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for trajectory, map and report.")],
    mode: Annotated[
        Literal["map", "localise", "continue"],
        typer.Option(help="A new map; the robot found on a saved one, which stays; a saved one that goes on."),
    ] = "map",
    saved_map: Annotated[Path | None, typer.Option("--map", help="Folder of the saved map.", metavar="DIR")] = None,
    topic_scan: TopicScan = "",
    topic_odom: TopicOdom = "",
    base_frame: BaseFrame = "",
    odom_frame: OdomFrame = "",
) -> None:
    """Make a map of a logged drive, or find the robot on a saved one.

    Example: zenav slam intel.log --out out/intel
    """
    from zenav.convert.content import Choice
    from zenav.files import slam

    slam(log, out, mode, saved_map, Choice(topic_scan, topic_odom, "", base_frame, odom_frame))


@app.command(cls=Command, rich_help_panel=FILES)
def convert(
    source: Annotated[
        Path, typer.Argument(help="CARMEN log, ROS 1 or 2 bag (file or folder), or recording.", metavar="IN")
    ],
    out: Annotated[
        Path, typer.Argument(help="Its name tells the format: .mcap .bag .tum .log, or a folder: ROS 2.", metavar="OUT")
    ],
    to: Annotated[
        str,
        typer.Option(
            help="Format, where the name does not tell: ros2, ros2-sqlite, ros1, zenav, tum, carmen, foxglove, map.",
            autocompletion=_formats,
        ),
    ] = "",
    trajectory: Annotated[
        Literal["pose", "odom", "truth"] | None,
        typer.Option(help="For TUM: whose poses; without it the first there is."),
    ] = None,
    topic_scan: TopicScan = "",
    topic_odom: TopicOdom = "",
    topic_pose: Annotated[
        str, typer.Option(help="Of a bag: the pose's topic; without it: the best by type, or tf.")
    ] = "",
    base_frame: BaseFrame = "",
    odom_frame: OdomFrame = "",
    force: Annotated[bool, typer.Option("--force", help="Overwrite a file that is there.")] = False,
) -> None:
    """Write a log, a bag or a recording in another format: ROS 1 or 2 bag, TUM, CARMEN, Foxglove.

    Example: zenav convert run.mcap run_ros2 --to ros2
    """
    from zenav.convert.content import Choice
    from zenav.files import convert

    chosen = Choice(topic_scan, topic_odom, topic_pose, base_frame, odom_frame)
    convert(source, out, to, chosen, trajectory or "", force)


@app.command(cls=Command, rich_help_panel=FILES)
def replay(
    recording: Annotated[Path, typer.Argument(help="Recording.", metavar="FILE.mcap")],
    topics: Annotated[
        str, typer.Option("--topics", help="Play only these; a family (health) is all of its keys.", metavar="A,B")
    ] = "",
    remap: Annotated[
        list[str] | None, typer.Option("--remap", help="Play a topic under another key.", metavar="OLD=NEW")
    ] = None,
    rate: Annotated[float, typer.Option(min=0.01, max=100, help="Recorded seconds in a real one.")] = 1.0,
    start: Annotated[float, typer.Option(min=0, help="s from the recording's beginning.")] = 0.0,
    end: Annotated[float, typer.Option(min=0, help="s from the recording's beginning; 0: its end.")] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Again and again.")] = False,
    paused: Annotated[bool, typer.Option("--paused", help="Begin paused; space goes on, n steps.")] = False,
    now: Annotated[
        bool, typer.Option("--now", help="Stamps as if it happened now, so that live services take it.")
    ] = False,
    commands: Annotated[bool, typer.Option("--commands", help="Play what robots obey (cmd, goal, estop) too.")] = False,
    robot: Annotated[
        str,
        typer.Option(
            "--robot", help="Name to play under; with --through: whose configuration to take. Else the recorded."
        ),
    ] = "",
    stack: Stack = "0",
    through: Annotated[
        str, typer.Option(help="Not onto Zenoh: through these services, here, at full speed.", metavar="A,B")
    ] = "",
    out: Annotated[
        Path | None, typer.Option(help="With --through: recording of what they publish now.", metavar="OUT.mcap")
    ] = None,
    set_: Setting = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Field by field: the first difference and the largest.")
    ] = False,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(help="How far a number may be off to count as equal.", metavar="TOPIC[.FIELD]=VALUE"),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(help="Compare with this recording, as a table of figures.", metavar="OTHER.mcap"),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="With --against: both ways and maps, as a picture.", metavar="PNG")
    ] = None,
    pdb: Annotated[bool, typer.Option("--pdb", help="Where a service raises, open the debugger.")] = False,
) -> None:
    """Play a recording onto Zenoh, or feed it to services and compare what they say.

    Example: zenav replay run.mcap --through odometry,mapper --out again.mcap
    """
    from zenav.playback import Wish
    from zenav.replaying import Rerun, replay

    wish = Wish(topics, tuple(remap or ()), rate, start, end, loop, paused, now, commands)
    rerun = Rerun(through, out, tuple(set_ or ()), compare, tuple(tolerance or ()), against, picture, pdb)
    raise typer.Exit(replay(recording, robot, stack, wish, rerun))


@recording.command("info", cls=Command)
def recording_info(files: Recordings, as_json: Json = False) -> None:
    """What a recording holds: robot, versions, messages, rates, gaps, what is missed or damaged.

    Example: zenav recording info run.mcap
    """
    from zenav.recording.info import show

    raise typer.Exit(show(files, as_json))


@recording.command("cat", cls=Command)
def recording_cat(
    file: RecordingFile,
    keys: Annotated[list[str] | None, typer.Argument(metavar="TOPIC...", help="Like scan health/*; none: all.")] = None,
    begin: Begin = None,
    end: End = None,
    number: Annotated[int, typer.Option("--number", "-n", min=0, help="Messages; 0: all.")] = 0,
    attachment: Annotated[str, typer.Option(help="Instead, what is attached, like config.yaml.")] = "",
) -> None:
    """Write messages as JSON, one a line.

    Example: zenav recording cat run.mcap pose cmd/* --begin 10 --end 12.5
    """
    from zenav.recording.cat import cat

    raise typer.Exit(cat(file, keys or [], begin, end, number, attachment))


@recording.command("repair", cls=Command)
def recording_repair(
    file: RecordingFile,
    out: Annotated[Path | None, typer.Option(help="Here, not in its place.", metavar="OUT.mcap")] = None,
) -> None:
    """Give a recording that was not closed, or is damaged, its index back, and tell what is lost.

    Example: zenav recording repair run.mcap
    """
    from zenav.recording.rewrite import repair

    raise typer.Exit(repair(file, out))


@recording.command("trim", cls=Command)
def recording_trim(
    file: RecordingFile,
    out: NewRecording,
    begin: Begin = None,
    end: End = None,
    topics: Annotated[str, typer.Option(help="Only these, and the journals.", metavar="A,B")] = "",
) -> None:
    """Cut out a time and some topics, so that it still replays.

    Example: zenav recording trim run.mcap --begin 10 --end 70 --out minute.mcap
    """
    from zenav.recording.rewrite import trim

    raise typer.Exit(trim(file, out, begin, end, [key for key in topics.split(",") if key]))


@recording.command("merge", cls=Command)
def recording_merge(files: Recordings, out: NewRecording) -> None:
    """Join the parts of a recording.

    Example: zenav recording merge run.mcap run.part002.mcap --out whole.mcap
    """
    from zenav.recording.rewrite import merge

    raise typer.Exit(merge(files, out))


@recording.command("latency", cls=Command)
def recording_latency(
    file: RecordingFile,
    keys: Annotated[list[str] | None, typer.Argument(metavar="TOPIC...", help="Like scan health/*; none: all.")] = None,
    as_json: Json = False,
) -> None:
    """How old messages were when they were recorded, and how long a scan takes to cmd/vel: percentiles, ms.

    Example: zenav recording latency run.mcap scan pose
    """
    from zenav.recording.latency import latency

    raise typer.Exit(latency(file, keys or [], as_json))


@recording.command("plot", cls=Command)
def recording_plot(
    file: RecordingFile,
    fields: Annotated[list[str], typer.Argument(metavar="TOPIC:FIELD...", help="Like pose:map_from_base.x")],
    out: Annotated[Path | None, typer.Option(help="A picture, not the terminal.", metavar="OUT.png")] = None,
    begin: Begin = None,
    end: End = None,
) -> None:
    """Draw numbers over time.

    Example: zenav recording plot run.mcap cmd/vel:v odom:v --out v.png
    """
    from zenav.recording.plot import plot

    raise typer.Exit(plot(file, fields, out, begin, end))


@recording.command("mark", cls=Command)
def recording_mark(
    files: Recordings,
    remove: Annotated[bool, typer.Option("--remove", help="Take the mark away.")] = False,
) -> None:
    """Keep recordings from being removed when the recorder's budget is used up.

    Example: zenav recording mark recordings/x80-20261122-101500.mcap
    """
    from zenav.recording.mark import mark

    raise typer.Exit(mark(files, remove))


@bench.command("recording", cls=Command)
def bench_recording(
    hours: Annotated[float, typer.Option(min=0.01, max=10, help="h: length of the made-up recording.")] = 1.0,
    out: Out = None,
) -> None:
    """Reading, writing, opening and replaying recordings, against the mcap package; the recorder's share of a core.

    Example: zenav bench recording --out recording.json
    """
    from zenav.bench.recording import recording as run

    raise typer.Exit(run(hours, out))


@bench.command("office", cls=Command)
def bench_office(
    seeds: Seeds = "0-9",
    jobs: Annotated[int, typer.Option(min=1, help="Runs at a time (not with --live).")] = 1,
    out: Out = None,
    live: Annotated[bool, typer.Option("--live", help="As processes over Zenoh, in real time.")] = False,
    seconds: Annotated[float, typer.Option(min=5, help="s of the stack's time: give up after this long.")] = 2400.0,
    robot: RobotName = "x80sv",
    world: World = "office",
    set_: Setting = None,
) -> None:
    """Explore and drive to goals in an office, once a seed.

    Example: zenav bench office --seeds 0-9 --jobs 2 --out office.json
    """
    from zenav.bench.office import office

    raise typer.Exit(office(robot, world, seeds, jobs, out, live, seconds, set_ or []))


@bench.command("buildings", cls=Command)
def bench_buildings(
    buildings: Annotated[str, typer.Option(help="Made-up buildings, by number.", metavar="0-19")] = "0-19",
    jobs: Annotated[int, typer.Option(min=1, help="Buildings at a time.")] = 1,
    out: Out = None,
    robot: RobotName = "x80sv",
    set_: Setting = None,
) -> None:
    """Tour made-up buildings: pose and map against the truth.

    Example: zenav bench buildings --jobs 2 --out buildings.json
    """
    from zenav.bench.buildings import buildings as run

    raise typer.Exit(run(robot, buildings, jobs, out, set_ or []))


@bench.command("localise", cls=Command)
def bench_localise(
    buildings: Annotated[str, typer.Option(help="Made-up buildings, by number.", metavar="0-19")] = "0-19",
    poses: Annotated[int, typer.Option(min=1, help="Random poses, shared among the buildings.")] = 100,
    jobs: Annotated[int, typer.Option(min=1, help="Buildings at a time.")] = 1,
    maps: Annotated[
        Path | None, typer.Option(help="Folder of an earlier run, with the maps; none: each building is toured first.")
    ] = None,
    out: Out = None,
    robot: RobotName = "x80sv",
    set_: Setting = None,
) -> None:
    """Find the robot from nowhere on saved maps of made-up buildings; carry it away and find it again.

    Example: zenav bench localise --poses 100 --jobs 2 --out localise.json
    """
    from zenav.bench.localise import localise as run

    raise typer.Exit(run(robot, buildings, poses, jobs, maps, out, set_ or []))


@bench.command("sim", cls=Command)
def bench_sim(out: Out = None) -> None:
    """How many times faster than real time the simulator runs on one core.

    Example: zenav bench sim --out sim.json
    """
    from zenav.bench.table import sim

    raise typer.Exit(sim(out))


@bench.command("stack", cls=Command)
def bench_stack(
    seconds: Annotated[float, typer.Option(min=5, help="s of driving to measure.")] = 40.0,
    out: Out = None,
    robot: RobotName = "x80sv",
    world: World = "office",
    set_: Setting = None,
) -> None:
    """Latency from scan to cmd/vel across processes, CPU and memory of each, time to first motion.

    Example: zenav bench stack --out stack.json
    """
    from zenav.bench.stack import stack

    raise typer.Exit(stack(robot, world, seconds, out, set_ or []))


@bench.command("serial", cls=Command)
def bench_serial(
    seconds: Annotated[float, typer.Option(min=1, help="s to measure.")] = 20.0,
    out: Out = None,
) -> None:
    """Delays of base_driver between its serial line and the stack, and how fast the hardware decoders are.

    Example: zenav bench serial --seconds 30 --out serial.json
    """
    from zenav.bench.serial import serial

    raise typer.Exit(serial(seconds, out))


@bench.command("slam", cls=Command)
def bench_slam(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder with NAME.log.gz and NAME.relations or NAME.ref.tum.")
    ],
    out: Out = None,
    logs: Annotated[str, typer.Option(help="Only these, separated by commas.", metavar="A,B")] = "",
) -> None:
    """Map every log of a folder that has a reference: errors, CPU time and memory; a Markdown table beside the JSON.

    Example: zenav bench slam logs --out slam.json
    """
    from zenav.bench.slam import slam

    raise typer.Exit(slam(directory, [name for name in logs.split(",") if name], out))


app.add_typer(topic, name="topic", rich_help_panel=LOOK)
app.add_typer(map_, name="map", rich_help_panel=LOOK)
app.add_typer(config, name="config", rich_help_panel=LOOK)
app.add_typer(calibrate, name="calibrate", rich_help_panel=DRIVE)
app.add_typer(recording, name="recording", rich_help_panel=FILES)
app.add_typer(bench, name="bench", rich_help_panel=FILES)


def _complain(what: str, mend: str) -> NoReturn:
    sys.stderr.write(f"{what}\nhint: {mend}\n")
    raise typer.Exit(2)


def _status(arguments: list[str] | None) -> int:
    """Runs a command; errors that the user can mend become one line and a hint."""
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
        from shared.config import UserError

        if not isinstance(error, UserError):
            raise
        sys.stderr.write(f"{_one_line(error.what)}\nhint: {_one_line(error.mend)}\n")
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
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)  # Zenoh's threads are not daemons: a plain return could hang


if __name__ == "__main__":
    main()
