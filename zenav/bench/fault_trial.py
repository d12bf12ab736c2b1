# SPDX-License-Identifier: Apache-2.0
"""One fault in one drive: what is done to the stack, and what is measured from the fault on."""

import json
import re
import tempfile
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from math import inf, pi
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from services.sim.message_faults import SECOND_LASER_FAULTS
from shared import requests, topics
from shared.config import UserError, load_robot
from shared.geometry import Pose2, wrapped
from shared.messages import GuardStatus, Localization, Message, MotorCommand, NavState, NavStatus, PoseEstimate, Truth
from shared.requests import Break, Explore, Navigate
from shared.topics import Topic
from zenav.bench.fault_table import FAULT_ROWS, SEQUENCE, DriveMode, FaultRow

WORLD = """
start: {x: 1.0, y: 3.0}
walls:
  - {points: [[0, 0], [12, 0], [12, 6], [0, 6]], closed: true}
  - {points: [[4, 0], [4, 2]]}
  - {points: [[8, 6], [8, 4]]}
boxes:
  - {x: 2.5, y: 5.4, size: [0.8, 0.5]}
  - {x: 6.0, y: 0.6, size: [0.7, 0.6]}
  - {x: 10.0, y: 5.2, size: [0.6, 0.8]}
"""
"""Three rooms in a row: eleven metres straight on from the start to a wall."""

SENSORS = (
    "robot.bumpers=[{name: front, bearing: 0, width: 2.5}]",
    "robot.cliffs=[{name: ahead, x: 0.2, y: 0}]",
    "robot.estop_input=true",
    "robot.imu={}",
)
"""What can break, beside the sensors that the robot has anyway."""

SPEEDS = 0.3, 0.5, 0.8
"""m/s, the robot's top speed in a trial."""
FASTEST_REACHED = 0.6  # of the top speed, from which the random phase counts
LASTS = 4.0  # s
KILLED_FOR = 0.5, 3.0  # s, at least and at most
RESUMES_WITHIN = 12.0  # s after the fault
HEARS_WITHIN = 1.0  # s after the fault's end in which its reason still counts
WRONG = 0.3  # m
POSE_AGE = 1.0  # s: an older pose, or status of the navigator, is none
MOVES = 0.05  # m/s, or rad/s
KEYS: tuple[Topic[Any], ...] = (
    topics.TRUTH, topics.MOTORS, topics.CMD_VEL, topics.GUARD, topics.NAV_STATUS, topics.POSE, topics.BASE_STATUS,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class FaultTrial:
    """A place in the matrix: row of ROWS, mode, top speed (m/s), and the seed of world, noise and phase."""

    row: int
    mode: DriveMode
    speed: float
    seed: int


@dataclass(slots=True)
class FaultResult:
    """What came of a trial; times in ms from the fault on, infinite where it never came. `trouble`: no trial at all.

    lasts: s of the fault; of a kill, until the service is heard again; of the mapper's, the longest time without pose.
    """

    fault: str
    mode: str
    speed: float
    seed: int
    zero_ms: float = inf
    creep_ms: float = inf
    distance: float = 0.0  # m from the fault to the zero command, or to the fault's end
    driven: float = 0.0  # m during the whole fault
    contacts: int = 0
    reasons: list[str] = field(default_factory=list)
    right: bool | None = None  # the true reason was published; None: not judged
    wrong_while_good: float = 0.0  # s, the longest
    resumed: bool = False
    trouble: str = ""
    lasts: float = inf

    def as_json(self) -> dict[str, Any]:
        """With null for what never came."""
        return {name: None if value == inf else value for name, value in asdict(self).items()}


class FaultMeter:
    """Hears the stack; measures from `begin` on."""

    def __init__(self, blind_speed: float) -> None:
        self.blind_speed = blind_speed
        self.newest: dict[str, Any] = {}
        self.lock = threading.Lock()
        self.began: int | None = None
        self.at_begin: Truth | None = None
        self.zero: int | None = None
        self.creep: int | None = None
        self.zero_at: float | None = None  # m, the odometer then
        self.details: dict[str, str] = {}  # code -> all its details
        self.is_recording_reasons = False
        self.wrong_since: int | None = None
        self.wrong_longest = 0
        self.posed: int = 0  # ns, when the newest pose came
        self.longest_silence = 0  # ns, between two poses

    def add(self, key: str, message: Message, now: int) -> None:
        """A message that was published at `now`, ns."""
        with self.lock:
            self.newest[key] = message
            if self.began is None:
                return
            if isinstance(message, PoseEstimate):
                self._pose_error(message, now)
            if isinstance(message, MotorCommand) and self.zero is None and not (message.left or message.right):
                self.zero, self.zero_at = now, self.newest["sim/truth"].distance
            if key == "cmd/vel" and self.creep is None and abs(self.newest[key].v) <= self.blind_speed + 1e-6:
                self.creep = now
            if self.is_recording_reasons and isinstance(message, GuardStatus | NavStatus):
                self._tell(message.reason, message.detail)
            if self.is_recording_reasons and key == "base/status":
                self._tell(self.newest[key].fault, self.newest[key].detail)

    def begin(self, now: int) -> None:
        """The fault begins."""
        with self.lock:
            self.began, self.is_recording_reasons, self.at_begin = now, True, self.newest["sim/truth"]

    def without_pose(self, now: int) -> int:
        """ns, the longest time without a pose since the fault began."""
        with self.lock:
            return max(self.longest_silence, now - max(self.posed, self.began or 0))

    def _tell(self, code: str, detail: str) -> None:
        if code:
            self.details[code] = f"{self.details.get(code, '')} {detail}"

    def _pose_error(self, pose: PoseEstimate, now: int) -> None:
        """By when the pose came, not by its stamp, which may be what is wrong; 0.1 s of driving is far under WRONG."""
        truth: Truth = self.newest["sim/truth"]
        wrong = pose.map_from_base.distance(truth.start.inverse() @ truth.world_from_base) > WRONG
        silence = now - max(self.posed, self.began or 0)
        silent = silence > POSE_AGE * 1e9
        self.posed, self.longest_silence = now, max(self.longest_silence, silence)
        if not wrong or pose.state is not Localization.GOOD:
            self.wrong_since = None
            return
        self.wrong_since = now if self.wrong_since is None or silent else self.wrong_since
        self.wrong_longest = max(self.wrong_longest, now - self.wrong_since)


class StackUnderTest(Protocol):
    """A stack that can be driven and broken; in lockstep, or live."""

    meter: FaultMeter
    hand: tuple[float, float] | None
    """m/s and rad/s that a hand commands twenty times a second, or None."""
    repeats_sequence: bool
    """Scans come in the simulator's name, with fresh stamps and a sequence that stands still; live only."""

    @property
    def now(self) -> int: ...

    def run(self, seconds: float, until: Callable[[], bool] | None = None) -> bool: ...

    def ask(self, request: Any, message: Any) -> Any: ...

    def kill(self, name: str) -> None: ...

    def is_back(self, name: str) -> bool: ...

    def start(self, name: str) -> None: ...


def settings_of(robot: str, trial: FaultTrial, folder: Path) -> list[str]:
    """As for `--set`; the world is written into `folder`."""
    path = folder / "world.yaml"
    path.write_text(WORLD)
    speed = f"robot.drive.max_speed={trial.speed}"
    lasers = _second_laser(robot) if FAULT_ROWS[trial.row].name in SECOND_LASER_FAULTS else []
    return [f"sim.world={path}", f"sim.seed={trial.seed}", "sim.clutter_jitter=0", speed, *SENSORS, *lasers]


def _second_laser(robot: str) -> list[str]:
    """Gives a robot with one laser a second one like it, on the other side and turned by half a turn."""
    lasers = load_robot(robot).robot.all_lasers
    if len(lasers) > 1:
        return []
    front = lasers[0].model_dump() | {"name": "front"}
    mount = lasers[0].mount
    rear = front | {"name": "rear", "mount": {"x": -mount.x, "y": -mount.y, "yaw": wrapped(mount.yaw + pi)}}
    return [f"robot.laser={json.dumps(front)}", f"robot.lasers={json.dumps([front, rear])}"]


def run_trial(stack: StackUnderTest, trial: FaultTrial) -> FaultResult:
    """The whole trial on a stack that has just started."""
    row, random = FAULT_ROWS[trial.row], np.random.default_rng([trial.seed, trial.row])
    result = FaultResult(row.name, str(trial.mode), trial.speed, trial.seed)
    try:
        _start_driving(stack, trial, random)
    except UserError as error:
        result.trouble = error.what
        return result
    meter, contacts = stack.meter, stack.meter.newest["sim/truth"].n_contacts
    begun, lasts, killed = stack.now, _inject_fault(stack, row, random), row.killed
    stack.run(lasts, until=partial(stack.is_back, killed) if killed else None)
    result.lasts = (stack.now - begun) * 1e-9
    stack.repeats_sequence = False
    fault_end: Truth = meter.newest["sim/truth"]
    if killed:
        stack.start(killed)
    stack.run(HEARS_WITHIN)
    meter.is_recording_reasons = False
    if killed == "mapper":  # its poses may be back before its health is heard
        result.lasts = min(result.lasts, meter.without_pose(stack.now) * 1e-9)
    result.resumed = _resumes_work(stack, trial.mode, row.hand)
    _fill_in(result, row, meter, fault_end)
    result.contacts = meter.newest["sim/truth"].n_contacts - contacts
    return result


def _start_driving(stack: StackUnderTest, trial: FaultTrial, random: np.random.Generator) -> None:
    """Starts to drive, and waits for the random moment. Raises UserError where the robot does not get going."""
    if trial.mode is DriveMode.TELEOP:
        stack.hand = trial.speed, 0.0
    elif trial.mode is DriveMode.NAVIGATION:
        poses = Pose2(9.5, 0.0, 0.0), Pose2(0.5, 0.0, 0.0)
        _accepted(stack.ask(requests.NAVIGATE, Navigate(stack.now, poses, 0.0, 0, True)))
    else:
        _accepted(stack.ask(requests.EXPLORE, Explore(stack.now)))

    def drives() -> bool:
        return bool(abs(stack.meter.newest["sim/truth"].v) >= FASTEST_REACHED * trial.speed)

    if not stack.run(15.0, drives):
        raise UserError("the robot did not get going", "see the services' logs")
    ahead = 6.0 / trial.speed if trial.mode is not DriveMode.EXPLORATION else 4.0
    stack.run(float(random.uniform(0.0, ahead)))
    if not stack.run(15.0, drives):
        raise UserError("the robot did not get going again", "see the services' logs")


def _accepted(reply: Any) -> None:
    if not reply.accepted:
        raise UserError(f"refused: {reply.detail}", "see the services' logs")


def _inject_fault(stack: StackUnderTest, row: FaultRow, random: np.random.Generator) -> float:
    """The fault begins; for how many s at most."""
    if row.killed:
        stack.meter.begin(stack.now)
        stack.kill(row.killed)
        return float(random.uniform(*KILLED_FOR))
    stack.meter.begin(stack.now)
    name = "scan_silent" if row.name == SEQUENCE else row.name
    _accepted(stack.ask(requests.FAULT, Break(stack.now, name, LASTS, False)))
    stack.repeats_sequence = row.name == SEQUENCE
    return LASTS


def _resumes_work(stack: StackUnderTest, mode: DriveMode, hand: tuple[float, float]) -> bool:
    """Whether work goes on by itself: the robot moves for its task, or has ended it well; or as a hand commands."""
    if mode is DriveMode.TELEOP:
        stack.hand = hand

    def works() -> bool:
        truth, nav = stack.meter.newest["sim/truth"], stack.meter.newest["nav/status"]
        moves = bool(abs(truth.v) > MOVES or abs(truth.w) > MOVES)
        if mode is DriveMode.TELEOP:
            return moves
        if stack.now - nav.stamp > POSE_AGE * 1e9:
            return False  # from a navigator that is no more
        working = nav.state in (NavState.NAVIGATING, NavState.EXPLORING, NavState.RECOVERING)
        return (working and moves) or bool(nav.state is NavState.REACHED)

    return stack.run(RESUMES_WITHIN, works)


def _fill_in(result: FaultResult, row: FaultRow, meter: FaultMeter, fault_end: Truth) -> None:
    began, first = meter.began or 0, meter.at_begin
    assert first is not None
    if meter.zero is not None:
        result.zero_ms = (meter.zero - began) * 1e-6
    if meter.creep is not None:
        result.creep_ms = (meter.creep - began) * 1e-6
    zero_at = fault_end.distance if meter.zero_at is None else min(meter.zero_at, fault_end.distance)
    result.distance, result.driven = zero_at - first.distance, fault_end.distance - first.distance
    result.reasons = sorted(meter.details)
    if row.reasons:
        result.right = any(
            re.search(row.detail, detail) for code, detail in meter.details.items() if code in row.reasons
        )
    result.wrong_while_good = meter.wrong_longest * 1e-9


def lockstep(robot: str, trial: FaultTrial) -> FaultResult:
    """A trial on the virtual clock."""
    from zenav.bench.fault_rigs import LockstepStack

    with tempfile.TemporaryDirectory() as folder:
        return run_trial(LockstepStack(robot, settings_of(robot, trial, Path(folder))), trial)


def live(robot: str, trial: FaultTrial) -> FaultResult:
    """A trial with processes over Zenoh, in real time."""
    from zenav.bench.fault_rigs import live_stack

    with (
        tempfile.TemporaryDirectory() as folder,
        live_stack(robot, settings_of(robot, trial, Path(folder)), Path(folder)) as stack,
    ):
        return run_trial(stack, trial)
