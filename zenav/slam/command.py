# SPDX-License-Identifier: Apache-2.0
"""`zenav slam`: the mapper over a log, with a progress bar and a summary."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from shared.config import UserError
from zenav.console.progress import progress_bar

if TYPE_CHECKING:
    from zenav.convert.content import Choice

MIN_LAG_S = 0.05  # s between odometry and laser, from which a note is printed


def slam_command(
    log: Path,
    out: Path,
    mode: Literal["map", "localise", "continue"],
    saved_map: Path | None,
    choice: "Choice",
    registrar: Literal["line", "kiss"] = "line",
) -> None:
    """The mapper over a log; writes into `out` and says what came of it."""
    if not log.exists():
        raise UserError(f"there is no log {log}", "give the path of a CARMEN log, a bag or a recording")
    from shared.robot_files import ROBOTS_DIR
    from zenav.stack.warm import warm_first

    warm_first(str(ROBOTS_DIR / "x80sv.yaml"), [f"mapper.registration.registrar={registrar}"], ["mapper"])
    from zenav.slam.offline_slam import config_with_registrar
    from zenav.slam.offline_slam import offline_slam as run

    with progress_bar(log.name) as progress:
        report = run(
            log, out, progress, config_with_registrar(registrar), mode=mode, saved_map=saved_map, choice=choice
        )
    sys.stdout.write(
        f"{out}/map.png: {report['scans_placed']} of {report['scans']} scans, {report['length_m']:.1f} m, "
        f"{report['loops']} loops closed, {report['cpu_s']:.1f} s of CPU\n"
    )
    lag, corrected = report["odometry_lag_s"], report["odometry_lag_corrected_s"]
    if corrected or abs(lag or 0.0) >= MIN_LAG_S:
        late = corrected or lag
        end = ": its stamps were corrected" if corrected else ""
        sys.stdout.write(f"odometry is {abs(late):.2f} s {'late' if late > 0 else 'early'} against the laser{end}\n")
    if report["truncated"]:
        sys.stderr.write(f"{log} ends early: its rest is missing, the map is of what came before\n")
    for note in report["notes"]:
        sys.stderr.write(f"{note}\n")
    for unit in ("lines", "messages"):
        if n := report.get(f"bad_{unit}", 0):
            sys.stderr.write(f"{log}: {n} {unit} could not be read and were left out\n")
