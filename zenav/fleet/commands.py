# SPDX-License-Identifier: Apache-2.0
"""`zenav fleet list`, `stop`, `goto`: all robots of some stacks, or one of them by its name."""

import json
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict

from shared.config import UserError, nearest
from shared.robot_view import FleetRow, RobotView
from shared.runners.fleet_listener import FleetListener
from shared.runners.stop_confirmation import confirm_stop_of
from shared.runners.transport import stack_address
from zenav.client.navigation_client import drive_route
from zenav.client.places import goal_from
from zenav.console.shutdown import stop_on_signal
from zenav.console.table import show_table
from zenav.fleet.stacks import chosen_stacks

LOOK_S = 2.0  # s in which each robot that runs is heard: its status comes five times a second
MAX_AT_ONCE = 256  # robots that are stopped at the same time: one that is away holds up no other


def list_robots(stacks: list[str], seconds: float, watch: bool, as_json: bool) -> int:
    """Shows every robot; 1 where there is none. watch: again and again until Ctrl-C."""
    chosen = chosen_stacks(stacks)
    with stop_on_signal() as stop, FleetListener(chosen) as fleet:
        while True:
            views = fleet.hear(seconds)
            fleet.ask_addresses()
            rows = [view.row(time.monotonic()) for view in views]
            _show(rows, as_json)
            if not watch or stop.is_set():
                break
    if not rows:
        raise UserError(f"no robot in {_stacks_text(chosen)}", "start one: zenav up --name red")
    return 0


def stop_robots(stacks: list[str], names: Sequence[str], every: bool) -> int:
    """Presses STOP of robots by name, or of all, and waits until each guard confirms; 1 where one does not.

    Each robot is stopped as soon as it is heard. With one stack a named robot gets it without being heard too.
    """
    if every == bool(names):
        raise UserError("name the robots, or all of them", "zenav fleet stop red blue, or zenav fleet stop --all")
    chosen = chosen_stacks(stacks)
    with ThreadPoolExecutor(len(chosen)) as pool:  # a stack that is away holds up no other
        stops = {stack: pool.submit(_stop_robots_of, stack, names, len(chosen) == 1) for stack in chosen}
    n_stopped, heard, failed = 0, set[str](), list[str]()
    for stack, future in stops.items():
        try:
            errors = future.result()
        except UserError as error:
            if len(chosen) == 1:
                raise
            failed.append(f"stack {stack}: {error.what}")
            continue
        heard |= errors.keys()
        n_stopped += sum(not error for error in errors.values())
        failed += [f"{name}: {error}" for name, error in errors.items() if error]
    failed += [f"{name}: it was not heard in {_stacks_text(chosen)}" for name in names if name not in heard]
    if not heard and not failed:
        raise UserError(f"no robot in {_stacks_text(chosen)}", "name the robots' router: --stack tcp/HOST:7447")
    sys.stdout.write(f"STOP is pressed on {n_stopped} robot{'s' if n_stopped != 1 else ''}\n")
    for line in failed:
        sys.stderr.write(f"{line}\n")
    if failed:
        sys.stderr.write("hint: switch them off by hand\n")
    return 1 if failed else 0


def send_robot(stacks: list[str], name: str, where: list[str], map_folder: str) -> int:
    """Drives the robot `name` to a pose or a place, as `zenav goto` does; 0 when it is reached."""
    goal = goal_from(where, map_folder)
    chosen = chosen_stacks(stacks)
    with FleetListener(chosen) as fleet:
        views = fleet.hear(LOOK_S)
        found = [view for view in views if view.name == name]
    if not found:
        known = tuple(view.name for view in views)
        raise UserError(f"no robot {name} in {_stacks_text(chosen)}", nearest(name, known) if known else "start one")
    if len(found) > 1:
        at = " and ".join(f"stack {view.stack}" for view in found)
        raise UserError(f"{at} have a robot named {name}", "name the stack: --stack, or give each its own name")
    return drive_route(f"{name}@x80sv", found[0].stack, [goal])


def _stop_robots_of(stack: str, names: Sequence[str], is_alone: bool) -> dict[str, str]:
    """Presses STOP of the robots of a stack by name, of all without names; by robot why it is not confirmed, or "".

    is_alone: no other stack may have a robot of these names. Raises UserError where the stack's router is away.
    """
    stops: dict[str, Future[None]] = {}
    with FleetListener([stack]) as fleet, ThreadPoolExecutor(MAX_AT_ONCE) as pool:

        def begin(views: list[RobotView]) -> bool:
            for view in views:
                if view.name not in stops and (not names or view.name in names):
                    stops[view.name] = pool.submit(_stop, view.name, stack)
            return False

        begin([RobotView(name, stack) for name in names] if is_alone else [])
        fleet.hear(LOOK_S, begin)
    return {name: _error(future) for name, future in stops.items()}


def _stop(name: str, stack: str) -> None:
    confirm_stop_of(name, stack_address(stack), True, "zenav fleet stop")


def _error(stop: Future[None]) -> str:
    error = stop.exception()
    return "" if error is None else error.what if isinstance(error, UserError) else str(error)


def _show(rows: list[FleetRow], as_json: bool) -> None:
    if as_json:
        for row in rows:
            sys.stdout.write(json.dumps(asdict(row)) + "\n")
        sys.stdout.flush()
        return
    twice = {row.name for row in rows if sum(other.name == row.name for other in rows) > 1}
    columns = ("robot", "state", "task", "pose", "map", "battery", "link", "version", "at")
    show_table("", columns, [_cells(row, row.name in twice) for row in rows])
    for name in sorted(twice):
        sys.stderr.write(f"several robots are named {name}\nhint: give each its own name: zenav up --name NAME\n")


def _cells(row: FleetRow, is_twice: bool) -> tuple[str, ...]:
    link = "-" if row.received is None or row.delay is None else f"{row.received:.0%}, {row.delay * 1e3:.0f} ms"
    return (
        f"{row.name}{' (twice)' if is_twice else ''}",
        row.state + (f": {row.reason}" if row.reason else ""),
        row.task or "-",
        "-" if row.x is None else f"{row.x:.1f} {row.y:.1f} {row.yaw:.0f}° {row.pose_state}",
        row.map or "-",
        "-" if row.battery is None else f"{row.battery:.1f} V",
        link,
        row.version or "-",
        f"stack {row.stack}" + (f", {row.address}" if row.address else ""),
    )


def _stacks_text(stacks: list[str]) -> str:
    return f"stack{'s' if len(stacks) > 1 else ''} {', '.join(stacks)}"
