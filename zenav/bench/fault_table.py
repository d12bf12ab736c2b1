# SPDX-License-Identifier: Apache-2.0
"""The rows of `zenav bench faults`: what fails, how soon the robot must stand, and the reasons that are true."""

from dataclasses import dataclass
from enum import StrEnum

AT_ONCE, SOON = 250.0, 600.0
"""ms to the zero command: where one message shows the fault, and where several must."""


class DriveMode(StrEnum):
    """What the robot is doing when the fault begins."""

    TELEOP = "teleop"
    NAVIGATION = "navigation"
    EXPLORATION = "exploration"


ALL = frozenset(DriveMode)
BY_ITSELF = ALL - {DriveMode.TELEOP}


@dataclass(frozen=True, slots=True)
class FaultRow:
    """One fault.

    name: of `zenav fault`, of a service after `kill `, or SEQUENCE.
    reasons: any of these codes is true; none: not judged.
    limit: ms to the zero command in the modes `stops`; in others of `creeps`, to at most the guard's blind speed.
    detail: a pattern that the reason's detail must hold.   resumes: whether work must go on after the fault;
    a fault of the hardware ends the task.   hand: m/s and rad/s by which a hand goes on after it.
    live_only: lockstep has nothing that it could break.
    """

    name: str
    reasons: frozenset[str]
    limit: float = SOON
    stops: frozenset[DriveMode] = ALL
    creeps: frozenset[DriveMode] = frozenset()
    detail: str = ""
    resumes: bool = True
    hand: tuple[float, float] = 0.0, 0.5
    live_only: bool = False

    @property
    def killed(self) -> str:
        """The service that the fault kills, or nothing."""
        return self.name.removeprefix("kill ") if self.name.startswith("kill ") else ""


def _blind(name: str, limit: float = SOON) -> FaultRow:
    """A hand may creep without a view; what drives by itself must stand."""
    return FaultRow(name, frozenset({"scan_blind"}), limit, BY_ITSELF, frozenset({DriveMode.TELEOP}))


def _stamped(source: str, kind: str) -> FaultRow:
    detail = rf"{source}: stamps are {STAMP_WORDS[kind]}"
    return FaultRow(f"{source}_{kind}", frozenset({"bad_stamps"}), SOON, detail=detail)


def _killed(name: str, reasons: set[str], limit: float = AT_ONCE, stops: frozenset[DriveMode] = ALL) -> FaultRow:
    return FaultRow(f"kill {name}", frozenset(reasons), limit, stops)


SEQUENCE = "scan_sequence"
"""The scans' sequence stands still: what comes is dropped as old."""

STAMP_WORDS = {
    "seconds": r"\d+ years old; are they ns\?",
    "1970": r"\d+ years old; are they ns\?",
    "late": r"0\.[5-7] s old",
    "old": r"10\.[0-2] s old",
    "ahead": r"(0\.9|1\.0) s ahead",
    "future": "1 h ahead",
}
"""Kind of wrong stamp -> how far off the detail must say that it is; a scan's age counts from its last beam."""

FAULT_ROWS: tuple[FaultRow, ...] = (
    _blind("scan_nan"),
    _blind("scan_mostly_nan"),
    _blind("scan_inf"),
    _blind("scan_dark_ahead"),
    _blind("scan_body"),
    FaultRow("scan_frozen", frozenset({"scan_frozen"})),
    FaultRow("scan_beams", frozenset({"scan_unlike"}), AT_ONCE, detail=r"\d+ beams came, robot.laser.n_beams is \d+"),
    FaultRow("scan_silent", frozenset({"scan_old"}), SOON),
    FaultRow("encoder_jumps", frozenset({"encoders_jump"}), SOON),
    FaultRow("sonar_dead", frozenset({"sensor_dead"}), SOON, resumes=False),
    FaultRow("ranges_missing", frozenset({"wrong_ranges"}), SOON, resumes=False),
    FaultRow(
        "bumper", frozenset({"bumper"}), AT_ONCE, detail="front", hand=(-0.2, 0.0)
    ),  # what was touched stays there
    FaultRow("cliff", frozenset({"cliff"}), AT_ONCE, detail="ahead"),
    FaultRow("estop_input", frozenset({"estop_input"}), AT_ONCE, resumes=False),
    FaultRow("contacts_silent", frozenset({"contacts_old"}), SOON),
    FaultRow("imu_silent", frozenset(), stops=frozenset()),
    FaultRow("imu_old", frozenset(), stops=frozenset()),
    *(_stamped(source, kind) for source in ("scan", "board") for kind in STAMP_WORDS),
    FaultRow(SEQUENCE, frozenset({"bad_stamps"}), SOON, detail="scan: the sequence stands still", live_only=True),
    _killed("navigator", set(), stops=frozenset()),
    _killed("odometry", {"odom_old"}),
    _killed("mapper", {"pose_old"}, 1100.0, BY_ITSELF),  # navigator and guard let it be silent for a second
    _killed("planner", set(), stops=frozenset()),  # a plan counts for 2 s: the robot may be there before
    _killed("local_ctrl", {"command_old"}, AT_ONCE, BY_ITSELF),
    _killed("guard", set()),  # the service that reports reasons is the one that died
    _killed("base_driver", {"odom_old", "base_silent", "board_silent"}, SOON, frozenset()),  # no command comes at all
    _blind("scan_2_nan"),
    FaultRow("scan_2_frozen", frozenset({"scan_frozen"}), detail=r"laser \w+: "),
    FaultRow(
        "scan_2_beams", frozenset({"scan_unlike"}), AT_ONCE, detail=r"beams came, robot.lasers.\w+.n_beams is \d+"
    ),
    FaultRow("scan_2_silent", frozenset({"scan_old"}), SOON, detail=r"laser \w+"),
    FaultRow("scan_2_old", frozenset({"bad_stamps"}), SOON, detail=rf"scan_2: stamps are {STAMP_WORDS['old']}"),
)
"""In the order of the table. A trial draws its random numbers by the place of its row, so new rows are the last."""
