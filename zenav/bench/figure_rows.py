# SPDX-License-Identifier: Apache-2.0
"""The published figures as a table: each row's command, its parts, and how the JSON of those becomes cells."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from zenav.bench import barn, buildings, localise, office, slam
from zenav.bench.barn import CROWDS_FITTED, CROWDS_UNSEEN

Report = dict[str, Any]
Cells = dict[str, list[list[str]]]
"""Rows of cells by the name of the table that they belong to."""

README = "measured"
LOGS = (
    "aces",
    "aces-sparse",
    "belgioioso",
    "edmonton",
    "fhw",
    "fr-clinic",
    "fr079",
    "fr079-raw",
    "intel",
    "intel-sparse",
)
COMPARED = "relations", "loops"  # kinds of pairs by which systems are compared
ROS_BUILDINGS = "0,1,2,6,7,8,12,19"


@dataclass(frozen=True, slots=True)
class FigureRow:
    """One row, or one command's rows, of the documents.

    what: the first cell in README, empty where it has none there.  command: as a user types it; DIR stands for `data`.
    cells: of the reports of all parts.  parts: options added to the command, one run each, so that hours of work can
    be interrupted.  data: folder of $ZENAV_DATA that it needs.  hidden: options that change no figure; {work} is a
    folder that stays while the code is the same.  jobs: whether it takes --jobs.
    """

    name: str
    what: str
    command: str
    cells: Callable[[Sequence[Report]], Cells]
    parts: tuple[str, ...] = ("",)
    data: str = ""
    hidden: str = ""
    jobs: bool = False


def _joined(reports: Sequence[Report], key: str) -> list[Any]:
    return [item for report in reports for item in report[key]]


def _office(reports: Sequence[Report]) -> Cells:
    s = office.summary(_joined(reports, "runs"))
    return {README: [[
        f"goals {s['goals_reached']} of {s['goals']}; contacts {s['collisions']}; worst run: mean pose error "
        f"{_cm(s['pose_error_mean_m_worst'])} and {_number(s['pose_error_mean_deg_worst'], 2)} degrees, largest "
        f"{_cm(s['pose_error_max_m_worst'])}, floor seen {_share(s['explored_share_min'])}, map precision "
        f"{_share(s['map_within_5_cm_min'])}, completeness {_share(s['map_completeness_min'])}"
    ]]}  # fmt: skip


def _demo(reports: Sequence[Report]) -> Cells:
    s = reports[0]["summary"]
    return {README: [[
        f"goals {s['goals_reached']} of {s['goals']}; contacts {s['collisions']}; mean pose error "
        f"{_cm(s['pose_error_mean_m'])}, largest {_cm(s['pose_error_max_m'])}; floor seen "
        f"{_share(s['explored_share'])}, map precision {_share(s['map_within_5_cm'])}, completeness "
        f"{_share(s['map_completeness'])}"
    ]]}  # fmt: skip


BUILDING_KEYS = (
    ("distance_m", 1, 0), ("pose_error_mean_m", 100, 2), ("pose_error_max_m", 100, 1),
    ("keyframe_error_mean_m", 100, 2), ("map_within_5_cm", 100, 1), ("aligned_within_5_cm", 100, 1),
    ("map_completeness", 100, 1), ("cpu_s", 1, 0),
)  # fmt: skip


def _buildings(reports: Sequence[Report]) -> Cells:
    runs = sorted(_joined(reports, "runs"), key=lambda run: int(run["building"]))
    s = buildings.summary(runs)
    lines = [
        [str(run["building"]), run["trouble"], "", "", *[""] * len(BUILDING_KEYS)]
        if run["trouble"]
        else [
            str(run["building"]),
            str(run["rooms"]),
            str(len(run["not_reached"])),
            str(run["collisions"]),
            *(f"{run[k] * scale:.{n}f}" for k, scale, n in BUILDING_KEYS),
        ]
        for run in runs
    ]
    mean = [f"{s[k]['mean'] * scale:.{n}f}" if k in s else "" for k, scale, n in BUILDING_KEYS]

    missed, touched = str(s["not_reached"]), str(s["collisions"])

    def of(key: str, which: str = "mean") -> float | None:
        return s[key][which] if key in s else None

    figure = (
        f"{s['kept']} of {s['buildings']} kept their limits; goals not reached {missed}, contacts {touched}; "
        f"mean pose error {_cm(of('pose_error_mean_m'))}, worst {_cm(of('pose_error_mean_m', 'worst'))}; "
        f"map precision {_share(of('map_within_5_cm'))}, after a rigid fit {_share(of('aligned_within_5_cm'))}; "
        f"completeness {_share(of('map_completeness'))}"
    )
    return {README: [[figure]], "buildings": [*lines, ["**mean**", "", missed, touched, *mean]]}


def _barn(added: str) -> Callable[[Sequence[Report]], Cells]:
    """Cells of BARN or crowds, whose line in the table begins with the options that were added."""

    def cells(reports: Sequence[Report]) -> Cells:
        runs = _joined(reports, "runs")
        s = barn.summary(runs)
        n = {status: sum(run["status"] == status for run in runs) for status in ("success", "collision", "timeout")}
        line = [
            added, str(s["runs"]), f"{s['success']:.3f}", str(n["collision"]), str(sum(run["stood"] for run in runs)),
            str(n["timeout"]), "-" if s["mean_time"] is None else f"{s['mean_time']:.1f}", f"{s['score']:.4f}",
            f"{s['clearance_min']:.3f}",
        ]  # fmt: skip
        figure = f"success {n['success']} of {s['runs']}; collisions {n['collision']}; time-outs {n['timeout']}"
        return {README: [[f"{figure}; score {s['score']:.4f}"]], "barn": [line]}

    return cells


def _localise(name: str) -> Callable[[Sequence[Report]], Cells]:
    """Cells of trials on maps of one kind, whose line in the table begins with its name."""

    def cells(reports: Sequence[Report]) -> Cells:
        trials = [localise.LocalizationTrial(**row) for row in _joined(reports, "trials")]
        s = localise.summary(trials)
        off = [t.found_error_m for t in trials if t.found_error_m is not None]
        n_found = round(s["found_share"] * s["poses"])
        line = [
            name, str(s["poses"]), str(n_found), _number(s["found_m_median"]), _number(s["found_m_p95"]),
            f"{sum(off) / len(off) * 100:.1f}, {max(off) * 100:.1f} at most" if off else "-", str(s["wrongly_sure"]),
            f"{s['noticed']} of {s['carried']}", _number(s["noticed_s_median"]), str(s["back"]),
            _number(s["back_m_median"]),
        ]  # fmt: skip
        figure = (
            f"found within 10 m {n_found} of {s['poses']}, wrongly sure {s['wrongly_sure']}; carried away: noticed "
            f"within 3 s {s['noticed']} of {s['carried']}, back within 10 m {s['back']}"
        )
        return {README: [[figure]], "localise": [line]}

    return cells


PLANNERS = (
    "ours, with costs", "ours, free and blocked", "raw, exact 8-connected", "NavFn A*, with costs",
    "NavFn Dijkstra, with costs", "NavFn A*", "NavFn Dijkstra", "pyastar2d", "scikit-image MCP",
)  # fmt: skip
SIZES = "256", "512", "1024", "4096"


def _plan(reports: Sequence[Report]) -> Cells:
    s = reports[0]["summary"]

    def times(size: str, name: str) -> str:
        row = s[size].get(name, {})
        return f"{row['ms_median']:.2f} / {row['ms_p99']:.2f}" if "ms_median" in row else "-"

    lines = []
    for name in PLANNERS:
        rows = [s[size][name] for size in SIZES if name in s[size]]
        n = sum(row["n"] for row in rows)
        solved = sum(row["solved"] * row["n"] for row in rows) / max(n, 1)
        touched = "-" if name.startswith("raw") else f"{sum(row['touched'] for row in rows)} of {n}"
        lengths = " ".join(f"{row['length']:.3f}" for row in rows if "length" in row) or "-"
        lines.append([name, *(times(size, name) for size in SIZES), f"{solved:.3f}", touched, lengths])
    real = [
        [where, name, *_of_building(row)]
        for where, rows in s.items()
        if where not in SIZES
        for name, row in rows.items()
        if name.startswith("ours") or name == "NavFn A*"
    ]
    free = "ours, free and blocked"
    figure = "; ".join(
        f"{size} cells: {times(size, 'ours, with costs')} ms, length {s[size][free]['length']:.3f} of the shortest; "
        f"NavFn A* {times(size, 'NavFn A*, with costs')} ms"
        for size in SIZES[:2]
    )
    return {README: [[figure]], "plan": lines, "plan-buildings": real}


def _of_building(row: Report) -> list[str]:
    def number(key: str, digits: int) -> str:
        return f"{row[key]:.{digits}f}" if key in row else "-"

    return [
        f"{row['ms_median']:.2f} / {row['ms_p99']:.2f}", number("path_m", 2), number("clearance_mean_m", 3),
        number("clearance_least_m", 3), number("length", 3), number("equal", 3), number("turn_deg", 1),
    ]  # fmt: skip


def _sim(reports: Sequence[Report]) -> Cells:
    return {README: [[f"{reports[0]['summary']['ratio']:.0f} times real time on one core"]]}


def _stack(reports: Sequence[Report]) -> Cells:
    s, parts = reports[0]["summary"], reports[0]["parts"]
    figure = (
        f"with the wait for the control tick p50 {s['with_wait_p50_ms']:.1f} ms, p99 {s['with_wait_p99_ms']:.1f} ms; "
        f"without p50 {s['latency_p50_ms']:.1f} ms, p99 {s['latency_p99_ms']:.1f} ms, {s['ratio_to_handlers_p50']} and "
        f"{s['ratio_to_handlers']} times the same scans' handlers; {s['n_scans_without_command']} of {s['n_scans']} "
        f"scans led to no command; first motion after {s['first_motion_s']:.1f} s"
    )
    lines = [[name, *(f"{row[p]:.1f}" for p in ("p50", "p95", "p99", "p100"))] for name, row in parts.items()]
    return {README: [[figure]], "stack": lines}


def _footprint(reports: Sequence[Report]) -> Cells:
    s = reports[0]["summary"]
    return {README: [[
        f"PSS {s['pss_mb']:.0f} MB without the simulator; {s['cpu'] * 100:.0f} % of a core without simulator and "
        f"recorder; a killed service speaks again after {s['restart_s_slowest_median']:.2f} s (median of the slowest); "
        f"first motion after {s['first_motion_s']:.1f} s"
    ]]}  # fmt: skip


def _serial(reports: Sequence[Report]) -> Cells:
    s = reports[0]["summary"]
    return {README: [[
        f"command: p50 {s['command_p50_ms']:.1f} ms, p99 {s['command_p99_ms']:.1f} ms; wheels: p50 "
        f"{s['wheels_p50_ms']:.1f} ms, p99 {s['wheels_p99_ms']:.1f} ms; {s['n_lost']} of {s['n']} lost"
    ]]}  # fmt: skip


def _slam(registrar: str) -> Callable[[Sequence[Report]], Cells]:
    """Cells of the logs by one registrar. Where systems are compared: log; mean and largest error, m; CPU, s."""

    def cells_of(reports: Sequence[Report]) -> Cells:
        figures = {name: row for report in reports for name, row in report["summary"].items()}
        beside = []
        for name, row in sorted(figures.items()):
            errors = next(row["errors"][kind] for kind in COMPARED if kind in row["errors"])
            mean, largest = errors["trans_mean_m"], errors["trans_max_m"]
            beside.append([name, f"{mean:.4f}", f"{largest:.3f}", f"{row['cpu_s']:.1f}"])
        figure = ", ".join(f"{name} {100 * float(mean):.1f} cm" for name, mean, *_ in beside)
        lines = [list(line) for name, row in sorted(figures.items()) for line in slam.rows_of(name, row)]
        cells = {README: [[figure]], f"beside-{registrar}": beside}
        return cells | {"slam-line": lines} if registrar == "line" else cells

    return cells_of


def _odometry(reports: Sequence[Report]) -> Cells:
    lines = [
        [
            name, f"{row['distance_max_m'] * 1e3:.3f}", f"{row['distance_end_m'] * 1e3:.3f}",
            f"{row['turn_max_deg']:.4f}",
        ]
        for name, row in reports[0]["rows"].items()
    ]  # fmt: skip
    rows = reports[0]["rows"]
    same, exact = (rows[f"{name}, encoder counts"] for name in ("document", "exact"))
    figure = (
        f"by the integration of its own driver (`document`) {same['distance_max_m'] * 1e3:.1f} mm and "
        f"{same['turn_max_deg']:.3f} degrees at most; by the stack's default (`exact`) "
        f"{exact['distance_max_m'] * 1e3:.0f} mm and {exact['turn_max_deg']:.1f} degrees"
    )
    return {README: [[figure]], "odometry": lines}


def _faults(name: str) -> Callable[[Sequence[Report]], Cells]:
    def cells(reports: Sequence[Report]) -> Cells:
        s = reports[0]["summary"]
        figure = (
            f"good {s['good']} of {s['trials']}; contacts {s['contacts']}; a pose over 0.3 m wrong was good for "
            f"{s['wrong_while_good_s']:.1f} s at most"
        )
        return {README: [[figure]], name: [[str(cell) for cell in row] for row in reports[0]["rows"]]}

    return cells


def _cm(metres: float | None) -> str:
    return "unknown" if metres is None else f"{metres * 100:.1f} cm"


def _share(share: float | None) -> str:
    return "unknown" if share is None else f"{share:.1%}".replace("%", " %")


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _spans(option: str, first: int, last: int, step: int, more: str = "") -> tuple[str, ...]:
    """`option` with each span of `step` numbers from first to last."""
    return tuple(f"{option} {low}-{min(low + step - 1, last)}{more}" for low in range(first, last + 1, step))


ROWS: tuple[FigureRow, ...] = (
    FigureRow(
        "office", "the office, whose people yield to the robot, on the virtual clock", "zenav bench office --seeds 0-9",
        _office, tuple(f"--seeds {seed}" for seed in range(10)), jobs=True,
    ),
    FigureRow(
        "office-live", "the same live, over Zenoh", "zenav bench office --live --seeds 10-14",
        _office, tuple(f"--seeds {seed}" for seed in range(10, 15)),
    ),
    FigureRow("demo", "the demo live, over Zenoh, one run", "zenav demo --headless --seconds 570", _demo),
    FigureRow(
        "buildings", "twenty made-up buildings, 10 to 33 rooms", "zenav bench buildings", _buildings,
        _spans("--buildings", 0, 19, 5), jobs=True,
    ),
    FigureRow(
        "localise", "found from nowhere on the saved maps of these, then carried away",
        "zenav bench localise --poses 100", _localise("the stack's own maps"),
        _spans("--buildings", 0, 19, 5, " --poses 25"), hidden="--maps {work}/maps", jobs=True,
    ),
    *(
        FigureRow(
            f"localise-ros-{cm}cm", "",
            f"zenav bench localise --map-format ros --cell {cm / 100:g} --buildings {ROS_BUILDINGS} --poses 40",
            _localise(f"pgm and yaml, {cm} cm"),
            tuple(f"--buildings {number} --poses 5" for number in ROS_BUILDINGS.split(",")),
            hidden="--maps {work}/maps", jobs=True,
        )
        for cm in (5, 10)
    ),
    FigureRow(
        "barn", "BARN's cluttered worlds, the 250 at hand, a Jackal without a map",
        "zenav bench barn DIR --runs 3", _barn("`--runs 3`"), _spans("--worlds", 0, 299, 50), "barn", jobs=True,
    ),
    FigureRow(
        "barn-noise", "the same worlds with a worse laser, odometry and latency",
        "zenav bench barn DIR --noise --runs 1", _barn("`--noise --runs 1`"), _spans("--worlds", 0, 299, 50), "barn",
        jobs=True,
    ),
    FigureRow(
        "crowd", "20 m through crowds of 5 to 24 non-reactive discs at up to 1.5 m/s; crowds used in development",
        f"zenav bench barn --crowd --worlds {CROWDS_FITTED} --runs 1",
        _barn(f"`--crowd --worlds {CROWDS_FITTED} --runs 1`"),
        _spans("--worlds", 0, 99, 25), jobs=True,
    ),
    FigureRow(
        "crowd-unseen", "the same through crowds that were never used",
        f"zenav bench barn --crowd --worlds {CROWDS_UNSEEN} --runs 1",
        _barn(f"`--crowd --worlds {CROWDS_UNSEEN} --runs 1`"),
        _spans("--worlds", 1000, 1099, 25), jobs=True,
    ),
    FigureRow(
        "slam", "real logs ([beside other systems](docs/benchmarks.md#beside-others)): mean error of relative poses",
        "zenav bench slam DIR", _slam("line"), tuple(f"--logs {log}" for log in LOGS), "slam",
    ),
    FigureRow(
        "slam-kiss", "", "zenav bench slam DIR --registrar kiss", _slam("kiss"), tuple(f"--logs {log}" for log in LOGS),
        "slam",
    ),
    FigureRow(
        "odometry", "the real X80SV's 273 s of wheels, from encoder counts, against the odometry that it recorded",
        "zenav bench odometry", _odometry, data="x80sv", hidden="DIR",
    ),
    FigureRow(
        "plan", "a path on game maps, costs included: CPU median / p99; NavFn is our reimplementation in numba",
        "zenav bench plan --limit 100", _plan, data="planning", hidden="DIR",
    ),
    FigureRow(
        "faults", "sensors, clocks and services that fail while the robot drives, in lockstep",
        "zenav bench faults --trials 58", _faults("faults"), jobs=True,
    ),
    FigureRow("faults-live", "the same live", "zenav bench faults --live", _faults("faults-live")),
    FigureRow("sim", "simulator, 720 beams at 40 Hz in a 1000 x 1000 cell map", "zenav bench sim", _sim),
    FigureRow("stack", "scan to `cmd/vel` across processes", "zenav bench stack --seconds 25", _stack),
    FigureRow("footprint", "memory, CPU and restarts of the live stack", "zenav bench footprint", _footprint),
    FigureRow("serial", "`cmd/vel` to the serial line, and the line to `base/wheels`", "zenav bench serial", _serial),
)  # fmt: skip
"""In the order of the README."""
