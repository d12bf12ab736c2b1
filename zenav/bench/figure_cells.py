# SPDX-License-Identifier: Apache-2.0
"""How the JSON of a benchmark's parts becomes the cells of the documents' tables."""

from collections.abc import Callable, Sequence
from typing import Any

from zenav.bench import barn, buildings, gyro, localise, merge, office, slam

Report = dict[str, Any]
Cells = dict[str, list[list[str]]]
"""Rows of cells by the name of the table that they belong to."""

README = "measured"
COMPARED = "relations", "loops"  # kinds of pairs by which systems are compared


def _joined(reports: Sequence[Report], key: str) -> list[Any]:
    return [item for report in reports for item in report[key]]


def office_cells(reports: Sequence[Report]) -> Cells:
    s = office.summary(_joined(reports, "runs"))
    return {README: [[
        f"goals {s['goals_reached']} of {s['goals']}; contacts {s['collisions']}; worst run: mean pose error "
        f"{_cm(s['pose_error_mean_m_worst'])} and {_number(s['pose_error_mean_deg_worst'], 2)} degrees, largest "
        f"{_cm(s['pose_error_max_m_worst'])}, floor seen {_share(s['explored_share_min'])}, map precision "
        f"{_share(s['map_within_5_cm_min'])}, completeness {_share(s['map_completeness_min'])}"
    ]]}  # fmt: skip


def demo_cells(reports: Sequence[Report]) -> Cells:
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


def buildings_cells(reports: Sequence[Report]) -> Cells:
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


def barn_cells(added: str) -> Callable[[Sequence[Report]], Cells]:
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


def localise_cells(name: str) -> Callable[[Sequence[Report]], Cells]:
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


def merge_cells(reports: Sequence[Report]) -> Cells:
    """A line a pair of maps of one building, and one line for all pairs that must be refused."""
    trials = [merge.MergeTrial(**row) for row in _joined(reports, "trials")]
    s = merge.summary(trials)
    lines = [list(merge.table_row(trial)) for trial in trials if trial.first == trial.second]
    others = [trial for trial in trials if trial.first != trial.second]
    refused = f"{sum(bool(trial.refused) for trial in others)} of {len(others)} refused"
    lines.append(["other buildings and floors", "", "", refused, *[""] * (len(merge.COLUMNS) - 4)])
    figure = f"joined {s['joined']} of {s['pairs']} pairs of one building; wrongly joined {s['wrongly_joined']} of all"
    return {README: [[f"{figure} {len(trials)}; mean error of the joint {_cm(s['joint_mean_m'])}"]], "merge": lines}


def gyro_cells(reports: Sequence[Report]) -> Cells:
    s = reports[0]["summary"]
    figure = f"mean of all drives: by wheels {s['wheels_deg']:.1f} degrees, by gyro {s['gyro_deg']:.1f}"
    return {README: [[figure]], "gyro": [list(line) for line in gyro.table_rows(reports[0])]}


def soak_cells(added: str) -> Callable[[Sequence[Report]], Cells]:
    """Cells of one long run, whose line in the table begins with the options that were added."""

    def cells(reports: Sequence[Report]) -> Cells:
        report = reports[0]
        s = report["summary"]
        drifting = next(key.removesuffix("_first") for key in s if key.endswith("_first"))
        growth = [] if s["faults"] else report["growth"]  # a service that restarts has no size of its own
        grown = max(growth, key=lambda row: row["memory_to"] / max(row["memory_from"], 1e-9), default=None)
        most = f"{grown['name']}, {grown['memory_from']:.1f} to {grown['memory_to']:.1f} MB" if grown else "-"
        line = [
            added, str(s["goals_reached"]), str(s["goals_failed"]), str(s["faults"]), str(s["contacts"]),
            _number(s["max_zero_s"], 2), _number(s["max_resume_s"]), str(s["not_resumed"]), most,
            f"{s[f'{drifting}_first']:.1f} to {s[f'{drifting}_last']:.1f}", _number(s["map_error_mean_m"], 3),
            _number(s["pose_error_mean_m"], 3), f"{s['recordings_mb']:.0f}",
        ]  # fmt: skip
        zero = "" if s["max_zero_s"] is None else f"; zero command after {s['max_zero_s']:.2f} s at most"
        stood = f"; did not drive on after {s['not_resumed']} of {s['faults']} faults" if s["faults"] else ""
        figure = (
            f"goals reached {s['goals_reached']}, failed {s['goals_failed']}; contacts {s['contacts']}{zero}{stood}; "
            f"mean wall error of the map {_cm(s['map_error_mean_m'])}; limits missed {len(report['broken'])}"
        )
        return {README: [[figure]], "soak": [[*line, "; ".join(report["broken"]) or "none"]]}

    return cells


PLANNERS = (
    "ours, with costs", "ours, free and blocked", "raw, exact 8-connected", "NavFn A*, with costs",
    "NavFn Dijkstra, with costs", "NavFn A*", "NavFn Dijkstra", "pyastar2d", "scikit-image MCP",
)  # fmt: skip
SIZES = "256", "512", "1024", "4096"


def plan_cells(reports: Sequence[Report]) -> Cells:
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


def sim_cells(reports: Sequence[Report]) -> Cells:
    return {README: [[f"{reports[0]['summary']['ratio']:.0f} times real time on one core"]]}


def stack_cells(reports: Sequence[Report]) -> Cells:
    s, parts = reports[0]["summary"], reports[0]["parts"]
    figure = (
        f"with the wait for the control tick p50 {s['with_wait_p50_ms']:.1f} ms, p99 {s['with_wait_p99_ms']:.1f} ms; "
        f"without p50 {s['latency_p50_ms']:.1f} ms, p99 {s['latency_p99_ms']:.1f} ms, {s['ratio_to_handlers_p50']} and "
        f"{s['ratio_to_handlers']} times the same scans' handlers; {s['n_scans_without_command']} of {s['n_scans']} "
        f"scans led to no command; first motion after {s['first_motion_s']:.1f} s"
    )
    lines = [[name, *(f"{row[p]:.1f}" for p in ("p50", "p95", "p99", "p100"))] for name, row in parts.items()]
    return {README: [[figure]], "stack": lines}


def footprint_cells(reports: Sequence[Report]) -> Cells:
    s = reports[0]["summary"]
    return {README: [[
        f"PSS {s['pss_mb']:.0f} MB without the simulator; {s['cpu'] * 100:.0f} % of a core without simulator and "
        f"recorder; a killed service speaks again after {s['restart_s_slowest_median']:.2f} s (median of the slowest); "
        f"first motion after {s['first_motion_s']:.1f} s"
    ]]}  # fmt: skip


def serial_cells(reports: Sequence[Report]) -> Cells:
    s = reports[0]["summary"]
    return {README: [[
        f"command: p50 {s['command_p50_ms']:.1f} ms, p99 {s['command_p99_ms']:.1f} ms; wheels: p50 "
        f"{s['wheels_p50_ms']:.1f} ms, p99 {s['wheels_p99_ms']:.1f} ms; {s['n_lost']} of {s['n']} lost"
    ]]}  # fmt: skip


def slam_cells(registrar: str) -> Callable[[Sequence[Report]], Cells]:
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


def odometry_cells(reports: Sequence[Report]) -> Cells:
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


def faults_cells(name: str) -> Callable[[Sequence[Report]], Cells]:
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
