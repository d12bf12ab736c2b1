# SPDX-License-Identifier: Apache-2.0
"""The published figures as a table: each row's command, its parts, and the function that makes its cells."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from zenav.bench.barn import CROWDS_FITTED, CROWDS_UNSEEN
from zenav.bench.figure_cells import (
    Cells,
    Report,
    barn_cells,
    buildings_cells,
    demo_cells,
    faults_cells,
    footprint_cells,
    gyro_cells,
    localise_cells,
    merge_cells,
    odometry_cells,
    office_cells,
    plan_cells,
    serial_cells,
    sim_cells,
    slam_cells,
    soak_cells,
    stack_cells,
)

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


def _spans(option: str, first: int, last: int, step: int, more: str = "") -> tuple[str, ...]:
    """`option` with each span of `step` numbers from first to last."""
    return tuple(f"{option} {low}-{min(low + step - 1, last)}{more}" for low in range(first, last + 1, step))


ROWS: tuple[FigureRow, ...] = (
    FigureRow(
        name="office",
        what="the office, whose people yield to the robot, on the virtual clock",
        command="zenav bench office --seeds 0-9",
        cells=office_cells,
        parts=tuple(f"--seeds {seed}" for seed in range(10)),
        jobs=True,
    ),
    FigureRow(
        name="office-live",
        what="the same live, over Zenoh",
        command="zenav bench office --live --seeds 10-14",
        cells=office_cells,
        parts=tuple(f"--seeds {seed}" for seed in range(10, 15)),
    ),
    FigureRow(
        name="demo",
        what="the demo live, over Zenoh, one run",
        command="zenav demo --headless --seconds 570",
        cells=demo_cells,
    ),
    FigureRow(
        name="buildings",
        what="twenty made-up buildings, 10 to 33 rooms",
        command="zenav bench buildings",
        cells=buildings_cells,
        parts=_spans("--buildings", 0, 19, 5),
        jobs=True,
    ),
    FigureRow(
        name="localise",
        what="found from nowhere on the saved maps of these, then carried away",
        command="zenav bench localise --poses 100",
        cells=localise_cells("the stack's own maps"),
        parts=_spans("--buildings", 0, 19, 5, " --poses 25"),
        hidden="--maps {work}/maps",
        jobs=True,
    ),
    *(
        FigureRow(
            name=f"localise-ros-{cm}cm",
            what="",
            command=f"zenav bench localise --map-format ros --cell {cm / 100:g} --poses 100",
            cells=localise_cells(f"pgm and yaml, {cm} cm"),
            parts=_spans("--buildings", 0, 19, 5, " --poses 25"),
            hidden="--maps {work}/maps",
            jobs=True,
        )
        for cm in (5, 10)
    ),
    FigureRow(
        name="merge",
        what="",
        command="zenav bench merge --buildings 0-2 --overlaps 30,50 --strangers 2",
        cells=merge_cells,
        hidden="--maps {work}/parts",
        jobs=True,
    ),
    FigureRow(
        name="barn",
        what="BARN's cluttered worlds, the 250 at hand, a Jackal without a map",
        command="zenav bench barn DIR --runs 3",
        cells=barn_cells("`--runs 3`"),
        parts=_spans("--worlds", 0, 299, 50),
        data="barn",
        jobs=True,
    ),
    FigureRow(
        name="barn-noise",
        what="the same worlds with a worse laser, odometry and latency",
        command="zenav bench barn DIR --noise --runs 1",
        cells=barn_cells("`--noise --runs 1`"),
        parts=_spans("--worlds", 0, 299, 50),
        data="barn",
        jobs=True,
    ),
    FigureRow(
        name="crowd",
        what="20 m through crowds of 5 to 24 non-reactive discs at up to 1.5 m/s; crowds used in development",
        command=f"zenav bench barn --crowd --worlds {CROWDS_FITTED} --runs 1",
        cells=barn_cells(f"`--crowd --worlds {CROWDS_FITTED} --runs 1`"),
        parts=_spans("--worlds", 0, 99, 25),
        jobs=True,
    ),
    FigureRow(
        name="crowd-unseen",
        what="the same through crowds that were never used",
        command=f"zenav bench barn --crowd --worlds {CROWDS_UNSEEN} --runs 1",
        cells=barn_cells(f"`--crowd --worlds {CROWDS_UNSEEN} --runs 1`"),
        parts=_spans("--worlds", 1000, 1099, 25),
        jobs=True,
    ),
    FigureRow(
        name="slam",
        what="real logs ([beside other systems](docs/benchmarks.md#beside-others)): mean error of relative poses",
        command="zenav bench slam DIR",
        cells=slam_cells("line"),
        parts=tuple(f"--logs {log}" for log in LOGS),
        data="slam",
    ),
    FigureRow(
        name="slam-kiss",
        what="",
        command="zenav bench slam DIR --registrar kiss",
        cells=slam_cells("kiss"),
        parts=tuple(f"--logs {log}" for log in LOGS),
        data="slam",
    ),
    FigureRow(
        name="odometry",
        what="the real X80SV's 273 s of wheels, from encoder counts, against the odometry that it recorded",
        command="zenav bench odometry",
        cells=odometry_cells,
        data="x80sv",
        hidden="DIR",
    ),
    FigureRow(
        name="gyro",
        what="",
        command="zenav bench gyro DIR",
        cells=gyro_cells,
        data="slam",
    ),
    FigureRow(
        name="plan",
        what="a path on game maps, costs included: CPU median / p99; NavFn is our reimplementation in numba",
        command="zenav bench plan --limit 100",
        cells=plan_cells,
        data="planning",
        hidden="DIR",
    ),
    FigureRow(
        name="faults",
        what="sensors, clocks and services that fail while the robot drives, in lockstep",
        command="zenav bench faults",
        cells=faults_cells("faults"),
        jobs=True,
    ),
    FigureRow(
        name="faults-dark",
        what="",
        command="zenav bench faults --only scan_dark_ahead --trials 45 --seed 11",
        cells=faults_cells("faults-dark"),
        jobs=True,
    ),
    FigureRow(
        name="faults-live", what="the same live", command="zenav bench faults --live", cells=faults_cells("faults-live")
    ),
    FigureRow(
        name="soak-hour",
        what="",
        command="zenav bench soak --hours 1 --lockstep",
        cells=soak_cells("`--hours 1 --lockstep`"),
    ),
    FigureRow(
        name="soak",
        what="half an hour from goal to goal in the office, live over Zenoh",
        command="zenav bench soak --minutes 30",
        cells=soak_cells("`--minutes 30`"),
    ),
    FigureRow(
        name="soak-faults",
        what="the same, while every 20 s a service is killed, or frozen for 1 to 8 s",
        command="zenav bench soak --minutes 30 --faults 20",
        cells=soak_cells("`--minutes 30 --faults 20`"),
    ),
    FigureRow(
        name="sim",
        what="simulator, 720 beams at 40 Hz in a 1000 x 1000 cell map",
        command="zenav bench sim",
        cells=sim_cells,
    ),
    FigureRow(
        name="stack",
        what="scan to `cmd/vel` across processes",
        command="zenav bench stack --seconds 25",
        cells=stack_cells,
    ),
    FigureRow(
        name="footprint",
        what="memory, CPU and restarts of the live stack",
        command="zenav bench footprint",
        cells=footprint_cells,
    ),
    FigureRow(
        name="serial",
        what="`cmd/vel` to the serial line, and the line to `base/wheels`",
        command="zenav bench serial",
        cells=serial_cells,
    ),
)
"""In the order of the README."""
