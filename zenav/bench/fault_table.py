# SPDX-License-Identifier: Apache-2.0
"""The rows of `zenav bench faults`: what fails, how soon the robot must stand, and the reasons that are true."""

from dataclasses import dataclass
from enum import StrEnum

AT_ONCE, SOON = 250.0, 600.0
"""ms to the zero command: where one message shows the fault, and where several must."""


class Mode(StrEnum):
    """What the robot is doing when the fault begins."""

    TELEOP = "teleop"
    NAVIGATION = "navigation"
    EXPLORATION = "exploration"


ALL = frozenset(Mode)
BY_ITSELF = ALL - {Mode.TELEOP}


@dataclass(frozen=True, slots=True)
class Row:
    """One fault.

    name: of `zenav fault`, of a service after `kill `, or SEQUENCE.
    reasons: any of these codes is true; none: not judged.
    limit: ms to the zero command in the modes `stops`; in others of `creeps`, to at most the guard's blind speed.
    detail: a word that the reason's detail must hold.   resumes: whether work must go on after the fault;
    a fault of the hardware ends the task.
    live_only: lockstep has nothing that it could break.
    """

    name: str
    reasons: frozenset[str]
    limit: float = SOON
    stops: frozenset[Mode] = ALL
    creeps: frozenset[Mode] = frozenset()
    detail: str = ""
    resumes: bool = True
    live_only: bool = False


def _blind(name: str, limit: float = SOON) -> Row:
    """A hand may creep without a view; what drives by itself must stand."""
    return Row(name, frozenset({"scan_blind", "scan_empty", "no_view"}), limit, BY_ITSELF, frozenset({Mode.TELEOP}))


def _scan_stamp(name: str) -> Row:
    return Row(name, frozenset({"scan_old", "scan_stamps"}), SOON, detail="stamp")


def _board_stamp(name: str) -> Row:
    return Row(name, frozenset({"odom_old", "base_silent", "board_silent", "board_stamps"}), SOON, detail="stamp")


def _killed(name: str, reasons: set[str], limit: float = AT_ONCE, stops: frozenset[Mode] = ALL) -> Row:
    return Row(f"kill {name}", frozenset(reasons), limit, stops)


SEQUENCE = "scan_sequence"
"""The scans' sequence stands still: what comes is dropped as old."""

ROWS: tuple[Row, ...] = (
    _blind("scan_nan"),
    _blind("scan_mostly_nan"),
    _blind("scan_inf"),
    _blind("scan_dark_ahead"),
    _blind("scan_body"),
    Row("scan_frozen", frozenset({"scan_frozen", "scan_repeats", "laser_frozen"})),
    Row("scan_beams", frozenset(), stops=frozenset()),
    Row("scan_silent", frozenset({"scan_old"}), SOON),
    Row("encoder_jumps", frozenset({"encoder_jumps", "encoders_jump"}), SOON, resumes=False),
    Row("sonar_dead", frozenset({"sensor_dead"}), SOON, resumes=False),
    Row("ranges_missing", frozenset({"sensor_dead", "ranges_wrong"}), SOON, resumes=False),
    *(_scan_stamp(f"scan_{name}") for name in ("seconds", "1970", "late", "old", "ahead", "future")),
    *(_board_stamp(f"board_{name}") for name in ("seconds", "1970", "late", "old", "ahead", "future")),
    Row(SEQUENCE, frozenset({"scan_old"}), SOON, detail="sequence", live_only=True),
    _killed("navigator", set(), stops=frozenset()),
    _killed("odometry", {"odom_old"}),
    _killed("mapper", {"pose_old"}, 1100.0, BY_ITSELF),  # navigator and guard let it be silent for a second
    _killed("planner", set(), stops=frozenset()),  # a plan counts for 2 s: the robot may be there before
    _killed("local_ctrl", {"command_old"}, AT_ONCE, BY_ITSELF),
    _killed("guard", set()),  # the one that tells is the one that died
    _killed("base_driver", {"odom_old", "base_silent", "board_silent"}, SOON, frozenset()),  # no command comes at all
)
"""In the order of the table."""
