# SPDX-License-Identifier: Apache-2.0
"""`zenav demo`: the scenario, watched; then picture, map, recording and summary in the run's folder."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from shared.config import UserError
from shared.messages import NavStatus
from shared.ros_map import replace_file
from zenav.console.json_report import check_writable
from zenav.console.json_report import write_report as save
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import StopFlag, stop_on_signal
from zenav.maps.map_files import write_map
from zenav.recording.selection import check_not_written
from zenav.render.floor_plan import floor_plan
from zenav.scenario import lockstep_run
from zenav.scenario.live_table import LineView, TableView
from zenav.scenario.mission import Mission
from zenav.scenario.scenario import Scenario, ScenarioResult, load_scenario
from zenav.stack.hardware import Hardware
from zenav.stack.page import with_page
from zenav.stack.warm import warm_first


def demo(
    robot: str,
    world: str,
    seed: int,
    seconds: float,
    headless: bool,
    record: Path | None,
    lockstep: bool,
    settings: list[str],
    hardware: Hardware,
    out: Path | None = None,
    page: bool = True,
    browser: bool = True,
) -> int:
    """Runs the scenario and writes what came of it; 0 only when every goal was reached without a collision.

    out: where the report goes too, besides the run's folder.  page: whether a live run has the page's server, and
    `browser`: whether a browser shows it in a desktop session.
    """
    chosen = load_scenario(robot, world, seed, settings, hardware)
    if not lockstep:
        chosen = replace(chosen, names=with_page(chosen.names, page))
    if record is not None and record.suffix != ".mcap":  # what stands there is written over
        raise UserError(f"{record} is no name for a recording", f"end it in .mcap: --record {record}.mcap")
    if record is not None:
        check_not_written(record)
    check_writable(out)
    folder = new_run_folder("demo")
    record = record or folder / "run.mcap"
    try:
        record.parent.mkdir(parents=True, exist_ok=True)
        record.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"cannot write {record}: {error.strerror}", "choose another place for --record") from None
    warm_first(robot, chosen.settings, chosen.names)
    with stop_on_signal() as stop:
        if lockstep:
            outcome = _run_lockstep(chosen, seconds, record, stop)
        else:
            from zenav.scenario.live_run import run_live

            plain = headless or not sys.stderr.isatty()
            view = LineView() if plain else TableView()
            outcome = run_live(chosen, seconds, folder, record, stop, view, browser=browser)
        if stop.is_set():
            sys.stderr.write("interrupted\n")
            return 130
    report = write_results(outcome, folder, record)
    print_summary(report, folder)
    save(out, report)
    return 0 if outcome.good else 1


def _run_lockstep(chosen: Scenario, seconds: float, record: Path, stop: StopFlag) -> ScenarioResult:
    lines = LineView()

    def tell(at: float, mission: Mission, nav: NavStatus | None) -> bool:
        lines.line(mission, nav, "", at)
        return not stop.is_set()

    return lockstep_run.run_lockstep(chosen, seconds, record, tell)


def write_results(outcome: ScenarioResult, folder: Path, record: Path) -> dict[str, Any]:
    """Writes map, picture and summary.json into the folder; returns the report."""
    report = outcome.report()
    report["recording"] = str(record)
    if not outcome.track.grid.empty:
        write_map(outcome.track.grid, folder)
    replace_file(folder / "picture.png", floor_plan(outcome.track, outcome.scenario.world, outcome.mission.goal_marks))
    replace_file(folder / "summary.json", (json.dumps(report, indent=2) + "\n").encode())
    return report


def print_summary(report: dict[str, Any], folder: Path) -> None:
    """The summary for people."""
    s = report["summary"]
    lines = [
        f"explored        {s['explored_share']:.1%} of the reachable floor",
        f"map             {s['map_within_5_cm']:.1%} of its wall cells within 5 cm of a true wall; "
        f"{s['map_completeness']:.1%} of the surfaces that its laser could see are in it",
        f"pose error      mean {_cm(s['pose_error_mean_m'])}, {_degrees(s['pose_error_mean_deg'])}; "
        f"max {_cm(s['pose_error_max_m'])}, {_degrees(s['pose_error_max_deg'])}",
        f"goals           {s['goals_reached']} of {s['goals']} reached",
        f"collisions      {s['collisions']}",
        f"driven          {s['distance_m']:.1f} m in {s['seconds']:.0f} s",
    ]
    if "first_motion_s" in s:
        lines.append(f"first motion    {s['first_motion_s']:.1f} s after the command")
    lines += [f"  {leg['name']:<18} {leg['state']} {leg['seconds']:6.1f} s  {leg['reason']}" for leg in report["legs"]]
    lines += [
        f"  {name:<18} CPU {row['cpu'] * 100:5.1f} %  {row['memory_mb']:6.0f} MB"
        for name, row in report["processes"].items()
    ]
    if report["restarts"]:
        lines.append(f"restarted       {report['restarts']}")
    if report["trouble"]:
        lines.append(f"ended early     {report['trouble']}")
    lines += [f"picture         {folder}/picture.png", f"map             {folder}/map.yaml"]
    lines += [f"recording       {report['recording']}", f"summary         {folder}/summary.json"]
    sys.stdout.write("\n".join(lines) + "\n")


def _cm(metres: float | None) -> str:
    return "unknown" if metres is None else f"{metres * 100:.1f} cm"


def _degrees(angle: float | None) -> str:
    return "unknown" if angle is None else f"{angle:.2f} degrees"
