# SPDX-License-Identifier: Apache-2.0
"""Every message. `stamp` is when it was true, ns on the stack's clock; when it was sent is the codec's envelope.

Each field declares its unit, shape and bounds once; validation, documentation and the fuzzing strategies read them
from here. Numbers are finite unless `Within(..., nan=True)` or `inf=True`. Arrays arrive read-only.
"""

import zlib
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import pi
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from shared.geometry import Pose2
from shared.types import Float32s, Float64s, Int8s, Int32s


@dataclass(frozen=True, slots=True)
class Unit:
    """The field's unit in words; "1" where it has none."""

    name: str


@dataclass(frozen=True, slots=True)
class Within:
    """Bounds, both inclusive, in the field's unit; nan: NaN is allowed and means 'nothing measured'.

    inf: +inf is allowed beside NaN and means 'nothing within range'.
    """

    low: float
    high: float
    nan: bool = False
    inf: bool = False


@dataclass(frozen=True, slots=True)
class Shape:
    """Names or numbers of the axes: "n", "n 2", "k 256". Equal names in one message are equal lengths."""

    axes: str


@dataclass(frozen=True, slots=True)
class NonZero:
    """The number is not 0."""


Metres = Annotated[float, Unit("m"), Within(-1e6, 1e6)]
Radians = Annotated[float, Unit("rad"), Within(-1e6, 1e6)]
Seconds = Annotated[float, Unit("s"), Within(0, 1e7)]
Speed = Annotated[float, Unit("m/s"), Within(-20, 20)]
TurnRate = Annotated[float, Unit("rad/s"), Within(-50, 50)]
Acceleration = Annotated[float, Unit("m/s^2"), Within(-400, 400, nan=True)]
Count = Annotated[int, Unit("1"), Within(0, 2**62)]
Stamp = Annotated[int, Unit("ns"), Within(0, 2**62)]
Text = Annotated[str, Unit("1")]
Flag = Annotated[bool, Unit("1")]
Pose = Annotated[Pose2, Unit("m, m, rad")]
Covariance = Annotated[Float64s, Unit("m, m, rad squared, row by row"), Shape("9"), Within(-1e12, 1e12)]


@dataclass(frozen=True, slots=True)
class Message:
    """Base of all messages."""

    stamp: Stamp

    def problem(self) -> str | None:
        """What is wrong between fields, or None. Called at the boundary, after each field was checked alone."""
        return None


MAX_CONTACTS = 64

# --- hardware -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class BoardReport(Message):
    """What the motion board measures. The left encoder counts down when the X80SV drives forward."""

    left_counts: Annotated[int, Unit("encoder counts, wrapping"), Within(0, 2**31)]
    right_counts: Annotated[int, Unit("encoder counts, wrapping"), Within(0, 2**31)]
    left_speed: Annotated[float, Unit("counts/s"), Within(-1e6, 1e6)]
    right_speed: Annotated[float, Unit("counts/s"), Within(-1e6, 1e6)]
    ultrasonic: Annotated[Float32s, Unit("m"), Shape("u"), Within(0, 20, nan=True)]
    infrared: Annotated[Float32s, Unit("m"), Shape("i"), Within(0, 20, nan=True)]
    battery: Annotated[float, Unit("V"), Within(0, 100, nan=True)]
    currents: Annotated[Float32s, Unit("A"), Shape("2"), Within(-200, 200)]


@dataclass(frozen=True, slots=True)
class MotorCommand(Message):
    """Wheel speeds for the board, in encoder counts a second with the board's signs. It stands until the next."""

    left: Annotated[float, Unit("counts/s"), Within(-1e6, 1e6)]
    right: Annotated[float, Unit("counts/s"), Within(-1e6, 1e6)]


MAX_VY = 1e-3  # m/s; below it, sideways speed is arithmetic noise


@dataclass(frozen=True, slots=True)
class BaseOdometry(Message):
    """Odometry of a base that controls its own speed: a pose, a twist, or both. Without one of them its fields are 0.

    The pose is continuous while `epoch` stays the same: when the base counted from 0 last. A covariance of zeros is
    unknown. `vy` must be 0: a holonomic base cannot be driven.
    """

    epoch: Stamp
    has_pose: Flag
    odom_from_base: Pose
    has_twist: Flag
    v: Speed
    vy: Speed
    w: TurnRate
    covariance: Covariance
    twist_covariance: Annotated[Float64s, Unit("m/s, m/s, rad/s squared, row by row"), Shape("9"), Within(-1e12, 1e12)]
    battery: Annotated[float, Unit("V"), Within(0, 100, nan=True)]

    def problem(self) -> str | None:
        if abs(self.vy) > MAX_VY:
            return f"vy is {self.vy:g} m/s: a holonomic base cannot be driven"
        return None if self.has_pose or self.has_twist else "neither a pose nor a twist"


@dataclass(frozen=True, slots=True)
class Imu(Message):
    """What an inertial sensor measures, turned into `base`: turn rate about z (up), and specific force.

    The yaw rate is the mean since the previous message, positive counter-clockwise, with the gyro's bias. The
    accelerations contain gravity: at rest z is +9.8 (REP 145). NaN where the sensor has no accelerometer.
    """

    yaw_rate: TurnRate
    acceleration_x: Acceleration
    acceleration_y: Acceleration
    acceleration_z: Acceleration


@dataclass(frozen=True, slots=True)
class Contacts(Message):
    """The names of the bumpers that are pressed and of the cliff sensors that see no floor, and the e-stop input.

    A publisher sends it 20 times a second, and at once when something changes: a silent one never means free.
    Names are those of `robot.bumpers` and `robot.cliffs`; the guard stops for any other name, too.
    """

    bumpers: Annotated[tuple[str, ...], Unit("1")]
    cliffs: Annotated[tuple[str, ...], Unit("1")]
    estop: Flag

    def problem(self) -> str | None:
        most = max(len(self.bumpers), len(self.cliffs))
        return f"more than {MAX_CONTACTS} contacts" if most > MAX_CONTACTS else None


@dataclass(frozen=True, slots=True)
class SerialData(Message):
    """Bytes of one of a service's ports, in their order. `stamp`: when they were read, or ordered to be written."""

    port: Text
    data: Annotated[bytes, Unit("bytes")]


@dataclass(frozen=True, slots=True)
class PortState(Message):
    """Whether a service's port is open; where it is not, `detail` gives the cause and a hint."""

    port: Text
    open: Flag
    detail: Text


# --- base -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class WheelState(Message):
    """Both wheels, positive when the robot drives forward. Angles are unwrapped since the driver's start (`epoch`)."""

    epoch: Stamp
    left: Radians
    right: Radians
    left_speed: Annotated[float, Unit("rad/s"), Within(-1000, 1000)]
    right_speed: Annotated[float, Unit("rad/s"), Within(-1000, 1000)]


@dataclass(frozen=True, slots=True)
class RangeReadings(Message):
    """Ultrasonic and infrared cones in `base`: where each sensor sits, looks, and what it sees. No echo is NaN."""

    x: Annotated[Float32s, Unit("m"), Shape("n"), Within(-10, 10)]
    y: Annotated[Float32s, Unit("m"), Shape("n"), Within(-10, 10)]
    yaw: Annotated[Float32s, Unit("rad"), Shape("n"), Within(-2 * pi, 2 * pi)]
    field_of_view: Annotated[Float32s, Unit("rad"), Shape("n"), Within(0, 2 * pi)]
    ranges: Annotated[Float32s, Unit("m"), Shape("n"), Within(0, 20, nan=True)]


@dataclass(frozen=True, slots=True)
class BaseStatus(Message):
    """State of the base for people and for the guard. `fault` is a reason's code, empty when there is none.

    `waits`: it stands until zero is commanded: after a fault, a stop or a new connection.
    """

    battery: Annotated[float, Unit("V"), Within(0, 100, nan=True)]
    left_current: Annotated[float, Unit("A"), Within(-200, 200)]
    right_current: Annotated[float, Unit("A"), Within(-200, 200)]
    link: Flag
    fault: Text
    detail: Text
    waits: Flag = False


@dataclass(frozen=True, slots=True)
class BoardStatus(Message):
    """How the line to the motion board is doing, and what else the board measures; NaN before it was measured.

    `rate` is of the packets with the encoders. `last_heard` is the age of the last good packet.
    """

    good: Annotated[Count, Unit("packets")]
    bad_crc: Annotated[Count, Unit("packets")]
    resyncs: Annotated[Count, Unit("times that bytes were no packet")]
    skipped: Annotated[Count, Unit("bytes")]
    last_heard: Annotated[float, Unit("s"), Within(0, 1e10, nan=True)]
    rate: Annotated[float, Unit("Hz"), Within(0, 1e6)]
    board_supply: Annotated[float, Unit("V"), Within(0, 200, nan=True)]
    motor_supply: Annotated[float, Unit("V"), Within(0, 400, nan=True)]
    servo_supply: Annotated[float, Unit("V"), Within(0, 200, nan=True)]
    left_temperature: Annotated[float, Unit("degrees C, motor driver"), Within(-1e4, 1e4, nan=True)]
    right_temperature: Annotated[float, Unit("degrees C, motor driver"), Within(-1e4, 1e4, nan=True)]
    temperature: Annotated[float, Unit("degrees C"), Within(-1e4, 1e4, nan=True)]


@dataclass(frozen=True, slots=True)
class LaserScan(Message):
    """One sweep in `laser`; beams run counter-clockwise when the increment is positive. No echo is NaN or +inf.

    `stamp` is the first beam's; the last beam was taken `scan_time` later. Any field of view, symmetric or not.
    Intensities are one a beam in the device's own scale, 0 where nothing came back, or none at all.
    """

    angle_min: Annotated[float, Unit("rad"), Within(-2 * pi, 2 * pi)]
    angle_increment: Annotated[float, Unit("rad"), NonZero(), Within(-pi, pi)]
    scan_time: Annotated[float, Unit("s"), Within(0, 2)]
    range_min: Annotated[float, Unit("m"), Within(0, 250)]
    range_max: Annotated[float, Unit("m"), Within(0, 250)]
    ranges: Annotated[Float32s, Unit("m"), Shape("n"), Within(0, 250, nan=True, inf=True)]
    intensities: Annotated[Float32s, Unit("1"), Shape("k"), Within(0, 65535)] = field(
        default_factory=lambda: np.empty(0, np.float32)
    )

    def problem(self) -> str | None:
        if len(self.ranges) < 2:
            return "fewer than 2 beams"
        if abs(self.angle_increment) * (len(self.ranges) - 1) > 2 * pi + 1e-3:
            return "the beams cover more than a full turn"
        return "range_min is not under range_max" if self.range_min >= self.range_max else None


# --- estimation -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Odometry(Message):
    """Dead reckoning: continuous, drifts. Covariance of the pose grows with travel."""

    odom_from_base: Pose
    v: Speed
    w: TurnRate
    covariance: Covariance


class Localization(StrEnum):
    """How far the pose can be trusted."""

    STARTING = "starting"
    GOOD = "good"
    POOR = "poor"
    LOST = "lost"


class MapMode(StrEnum):
    """What the mapper does with its map."""

    MAP = "map"  # begins a new, empty one
    LOCALISE = "localise"  # finds the robot on it, and leaves it as it is
    CONTINUE = "continue"  # finds the robot on it, and goes on mapping


@dataclass(frozen=True, slots=True)
class PoseEstimate(Message):
    """Where the robot is on the map, as of a scan. `quality` is the share of beams that agree with the map.

    `mode`: what the mapper does with its map. While the robot is looked for, `state` is lost.
    """

    map_from_base: Pose
    map_from_odom: Pose
    covariance: Covariance
    quality: Annotated[float, Unit("1"), Within(0, 1)]
    state: Annotated[Localization, Unit("1")]
    mode: Annotated[MapMode, Unit("1")] = MapMode.MAP


TILE_CELLS = 64  # a tile's side, in cells; 64 x 64 int8 is 4 kB on the wire
MAX_SPAN = 256  # tiles that a map is long and wide at most, 819 m at 0.05 m/cell: readers hold it dense


@dataclass(frozen=True, slots=True)
class MapUpdate(Message):
    """Changed tiles of the occupancy grid. -1 unknown, 0 free .. 100 occupied.

    Cell (row, column) of tile (i, j) is a square. Its lower left corner in `map` is at
    ((j * 64 + column) * resolution, (i * 64 + row) * resolution). A map spans at most 256 tiles each way. Tiles that
    would make it span more are no part of it.
    """

    map_id: Stamp
    version: Count
    resolution: Annotated[float, Unit("m/cell"), Within(0.005, 1)]
    rows: Annotated[Int32s, Unit("tiles"), Shape("k"), Within(-30000, 30000)]
    columns: Annotated[Int32s, Unit("tiles"), Shape("k"), Within(-30000, 30000)]
    cells: Annotated[Int8s, Unit("percent, -1 unknown"), Shape("k 4096"), Within(-1, 100)]

    def problem(self) -> str | None:
        spans = (int(places.max()) - int(places.min()) + 1 for places in (self.rows, self.columns) if len(places))
        return f"the tiles span more than {MAX_SPAN}" if max(spans, default=0) > MAX_SPAN else None

    def only(self, which: NDArray[np.bool_]) -> "MapUpdate":
        """The tiles that a mask (k,) selects."""
        return replace(self, rows=self.rows[which], columns=self.columns[which], cells=self.cells[which])

    def merged(self, later: "MapUpdate") -> "MapUpdate":
        """The whole map after `later`: its tiles replace those of one place. Another map_id starts a new map."""
        if later.map_id != self.map_id or later.resolution != self.resolution:
            return later
        fit = np.ones(len(later.rows), bool)
        if len(self.rows):
            fit &= fitting(later.rows, int(self.rows.min()), int(self.rows.max()))
            fit &= fitting(later.columns, int(self.columns.min()), int(self.columns.max()))
        tiles = {(int(r), int(c)): cells for r, c, cells in zip(self.rows, self.columns, self.cells)}
        tiles |= {(int(r), int(c)): cells for r, c, cells in zip(later.rows[fit], later.columns[fit], later.cells[fit])}
        places = sorted(tiles)
        return MapUpdate(
            stamp=later.stamp,
            map_id=later.map_id,
            version=later.version,
            resolution=later.resolution,
            rows=np.array([r for r, _ in places], np.int32),
            columns=np.array([c for _, c in places], np.int32),
            cells=np.array([tiles[p] for p in places], np.int8).reshape(len(places), TILE_CELLS * TILE_CELLS),
        )


def fitting(places: Int32s, first: int, last: int) -> NDArray[np.bool_]:
    """(k,) bool: rows (or columns) that extend a map from `first` to `last` to at most MAX_SPAN tiles.

    places: (k,) int32, of tiles. All of them together fit, too, where they span at most MAX_SPAN themselves.
    """
    return np.asarray((places > last - MAX_SPAN) & (places < first + MAX_SPAN))


class EditKind(StrEnum):
    """Kind of an edit of the map."""

    ERASE = "erase"  # its known cells are free
    WALL = "wall"  # its cells are occupied, whatever the laser sees


MAX_EDITS, MAX_EDIT_POINTS = 256, 256
MAX_EDIT_WIDTH_M, MAX_EDIT_XY_M = 5, 10_000


@dataclass(frozen=True, slots=True)
class MapEdit(Message):
    """A change of the map by a user, over what the laser saw. `id` is its own among the map's; the mapper chooses it.

    Points are in `map`. With a width it is a stroke along a polyline, without one the inside of a polygon (even-odd
    rule). A stroke changes every cell that its line crosses, at least.
    """

    id: Count
    kind: Annotated[EditKind, Unit("1")]
    xs: Annotated[Float64s, Unit("m"), Shape("n"), Within(-MAX_EDIT_XY_M, MAX_EDIT_XY_M)]
    ys: Annotated[Float64s, Unit("m"), Shape("n"), Within(-MAX_EDIT_XY_M, MAX_EDIT_XY_M)]
    width: Annotated[float, Unit("m"), Within(0, MAX_EDIT_WIDTH_M)]

    def problem(self) -> str | None:
        if self.kind is EditKind.WALL and self.width == 0:
            return "a wall without a width"
        least = 1 if self.width else 3
        return None if least <= len(self.xs) <= MAX_EDIT_POINTS else f"an edit of {len(self.xs)} points"


@dataclass(frozen=True, slots=True)
class MapState(Message):
    """What the tiles of the map do not show: the name under which it was saved or loaded, empty if none, and its edits.

    The tiles contain the edits.
    """

    map_id: Stamp
    name: Text
    edits: Annotated[tuple[MapEdit, ...], Unit("1")]

    def problem(self) -> str | None:
        return f"more than {MAX_EDITS} edits" if len(self.edits) > MAX_EDITS else None


# --- navigation -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Goal(Message):
    """The pose to plan and drive to, or, when it is not active, the order to stand.

    Goals and recoveries have one count: the highest `id` of both holds. `clear_costmap` forgets obstacles.
    """

    id: Count
    active: Flag
    map_from_goal: Pose
    tolerance: Annotated[float, Unit("m"), Within(0.01, 5)]
    yaw_tolerance: Annotated[float, Unit("rad; over pi: any heading"), Within(0.01, 10)]
    clear_costmap: Flag


class RecoveryKind(StrEnum):
    """What local control does to free a robot without progress."""

    BACK_UP = "back_up"  # straight back by `amount` m
    TURN = "turn"  # on the spot by `amount` rad
    WAIT = "wait"  # stand for `amount` s


@dataclass(frozen=True, slots=True)
class Recovery(Message):
    """A motion that frees a robot without progress. It holds until a goal or a recovery with a higher `id` comes."""

    id: Count
    kind: Annotated[RecoveryKind, Unit("1")]
    amount: Annotated[float, Unit("m, rad or s by kind"), Within(-100, 100)]


@dataclass(frozen=True, slots=True)
class Path(Message):
    """The way to the goal in `map`, or none and why. `reason` is a code of reasons.py, empty when there is a path.

    The last pose is where the robot will stop: the goal, or the nearest reachable pose within tolerance.
    """

    goal_id: Count
    map_version: Count
    reason: Text
    xs: Annotated[Float64s, Unit("m"), Shape("n"), Within(-1e6, 1e6)]
    ys: Annotated[Float64s, Unit("m"), Shape("n"), Within(-1e6, 1e6)]
    yaws: Annotated[Float64s, Unit("rad"), Shape("n"), Within(-10, 10)]
    length: Annotated[float, Unit("m"), Within(0, 1e6)]
    cost: Annotated[float, Unit("m, weighted"), Within(0, 1e9)]


@dataclass(frozen=True, slots=True)
class GoalLimits(Message):
    """Conditions of the planner for any goal. The navigator refuses other goals in its reply.

    The margins are around the footprint's inscribed circle, with cells of 5 cm. There must be room for `margin` within
    `reach` of the goal, or for `least_margin` at the goal itself.
    """

    margin: Annotated[float, Unit("m"), Within(0, 1)]
    least_margin: Annotated[float, Unit("m"), Within(0, 1)]
    reach: Annotated[float, Unit("m"), Within(0, 5)]
    beyond_map: Annotated[float, Unit("m outside the map's tiles"), Within(0, 50)]


class ZoneKind(StrEnum):
    """Kind of a zone."""

    KEEP_OUT = "keep_out"  # no part of it may enter
    SLOW = "slow"  # while its middle is inside it is slow


MAX_CORNERS, MAX_ZONES = 256, 256


@dataclass(frozen=True, slots=True)
class Zone(Message):
    """A polygon in `map`, corners in order, closed by itself (even-odd rule). `name` is its own among all.

    In a slow one the robot drives no faster than `speed`, nor than `share` of its top speed; else they mean nothing.
    """

    name: Text
    kind: Annotated[ZoneKind, Unit("1")]
    xs: Annotated[Float64s, Unit("m"), Shape("n"), Within(-1e6, 1e6)]
    ys: Annotated[Float64s, Unit("m"), Shape("n"), Within(-1e6, 1e6)]
    speed: Annotated[float, Unit("m/s"), Within(0.01, 20)] = 20.0
    share: Annotated[float, Unit("1"), Within(0.01, 1)] = 1.0

    def problem(self) -> str | None:
        return None if 3 <= len(self.xs) <= MAX_CORNERS else f"a zone of {len(self.xs)} corners"


@dataclass(frozen=True, slots=True)
class Zones(Message):
    """Every zone that holds from now on."""

    zones: Annotated[tuple[Zone, ...], Unit("1")]

    def problem(self) -> str | None:
        return f"more than {MAX_ZONES} zones" if len(self.zones) > MAX_ZONES else None


class FollowState(StrEnum):
    """What local control is doing."""

    IDLE = "idle"
    FOLLOWING = "following"
    BLOCKED = "blocked"
    ARRIVED = "arrived"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class FollowStatus(Message):
    """Local control's progress on the goal or recovery with this id.

    `reason` is a code of reasons.py while it does not move.
    """

    goal_id: Count
    state: Annotated[FollowState, Unit("1")]
    reason: Text
    distance_left: Metres


class NavState(StrEnum):
    """State of the navigator."""

    IDLE = "idle"
    NAVIGATING = "navigating"
    EXPLORING = "exploring"
    RECOVERING = "recovering"
    PAUSED = "paused"
    REACHED = "reached"
    FAILED = "failed"
    CANCELED = "canceled"


@dataclass(frozen=True, slots=True)
class NavStatus(Message):
    """The task, how far it is, and why the robot stands when it stands. `task_id` counts the requests it accepted.

    Distance and time left are those of a route's present round, stays included. `recovery` names the one that runs or
    was just made, `reason` and `detail` why. `n_rounds` is 0 where a route goes on for ever.
    """

    task_id: Count
    state: Annotated[NavState, Unit("1")]
    recovery: Text
    reason: Text
    detail: Text
    goal: Pose
    distance_left: Metres
    time_left: Seconds
    waypoint: Count
    n_waypoints: Count
    n_recoveries: Count
    round: Count = 0
    n_rounds: Count = 0


class TaskKind(StrEnum):
    """Kind of a navigator's task."""

    NONE = "none"
    ROUTE = "route"  # a goal is a route of one pose
    EXPLORE = "explore"


@dataclass(frozen=True, slots=True)
class NavTask(Message):
    """The navigator's task and how far it is, for the navigator that takes its place after a crash.

    Published with each change and every half second: `stamp` is when the navigator last lived. `map_id` is the map
    that the poses are on, 0 where there was none yet. `dwell` is what is left of the stay while `dwelling`.
    """

    task_id: Count
    kind: Annotated[TaskKind, Unit("1")]
    age: Seconds
    map_id: Stamp
    paused: Flag
    poses: Annotated[tuple[Pose, ...], Unit("m, m, rad")]
    dwells: Annotated[tuple[Seconds, ...], Unit("s, one a pose")]
    loops: Annotated[int, Unit("rounds; 0 is for ever"), Within(0, 10**6)]
    any_heading: Flag
    tolerance: Annotated[float, Unit("m"), Within(0, 5)]
    yaw_tolerance: Annotated[float, Unit("rad"), Within(0, 3.15)]
    waypoint: Count
    round: Count
    dwelling: Flag
    dwell: Seconds
    pass_through: Flag = False

    def problem(self) -> str | None:
        if self.kind is not TaskKind.ROUTE:
            return None
        if len(self.dwells) != len(self.poses):
            return f"{len(self.dwells)} stays for {len(self.poses)} poses"
        return None if self.waypoint < len(self.poses) else "a waypoint beyond the last pose"


MAX_COARSE_CELLS = 2**20  # of a map that is sent to other robots


@dataclass(frozen=True, slots=True)
class ExplorationShare(Message):
    """The part of a robot in an exploration with others, for these. Positions are in the frame that all have in common.

    `session` and `sequence` order the messages of one `robot`; a session is the time at which its exploration began.
    `task_id` and `others`, the robots that it explores with, are for its navigator after a restart.
    `active`: it has a frontier, or may get one. `claimed` is the frontier that it drives to, by its number, -1 without
    one. `frontier_costs` are m of driving. `closed` are borders at which it saw no more, `seen` frontiers that vanished
    when it was near.

    `cells` is its map in coarse cells: `rows` x `columns` int8, packed by zlib (RFC 1950); -1 unknown, 0 free, 100
    occupied. The lower left cell is (`first_row`, `first_column`) of that map.
    """

    robot: Text
    session: Stamp
    sequence: Count
    task_id: Count
    others: Annotated[tuple[Text, ...], Unit("1")]
    active: Flag
    common_from_map: Pose
    x: Metres
    y: Metres
    frontier_xs: Annotated[Float32s, Unit("m"), Shape("n"), Within(-1e6, 1e6)]
    frontier_ys: Annotated[Float32s, Unit("m"), Shape("n"), Within(-1e6, 1e6)]
    frontier_costs: Annotated[Float32s, Unit("m"), Shape("n"), Within(0, 1e6)]
    claimed: Annotated[int, Unit("1"), Within(-1, 1000)]
    closed_xs: Annotated[Float32s, Unit("m"), Shape("k"), Within(-1e6, 1e6)]
    closed_ys: Annotated[Float32s, Unit("m"), Shape("k"), Within(-1e6, 1e6)]
    seen_xs: Annotated[Float32s, Unit("m"), Shape("l"), Within(-1e6, 1e6)]
    seen_ys: Annotated[Float32s, Unit("m"), Shape("l"), Within(-1e6, 1e6)]
    cell: Annotated[float, Unit("m"), Within(0.01, 10)]
    first_row: Annotated[int, Unit("1"), Within(-(2**31), 2**31 - 1)]
    first_column: Annotated[int, Unit("1"), Within(-(2**31), 2**31 - 1)]
    rows: Annotated[int, Unit("1"), Within(0, MAX_COARSE_CELLS)]
    columns: Annotated[int, Unit("1"), Within(0, MAX_COARSE_CELLS)]
    cells: Annotated[bytes, Unit("zlib")]

    def coarse_cells(self) -> Int8s | None:
        """(rows, columns) int8, percent, -1 unknown; None where `cells` holds no such map."""
        n = self.rows * self.columns
        try:
            data = zlib.decompressobj().decompress(self.cells, n + 1) if n <= MAX_COARSE_CELLS else b""
        except zlib.error:
            return None
        return np.frombuffer(data, np.int8).reshape(self.rows, self.columns) if len(data) == n else None


@dataclass(frozen=True, slots=True)
class Velocity(Message):
    """A velocity in `base`. `reason` says why it is zero or slowed, empty when it is neither."""

    v: Speed
    w: TurnRate
    reason: Text


@dataclass(frozen=True, slots=True)
class EmergencyStop(Message):
    """STOP, latched: it holds until an operator releases it; releasing never moves the robot."""

    pressed: Flag
    by: Text


class GuardState(StrEnum):
    """Why the robot moves or stands."""

    IDLE = "idle"
    ACTIVE = "active"
    HOLD = "hold"
    STOPPED = "stopped"
    FAULT = "fault"


@dataclass(frozen=True, slots=True)
class GuardStatus(Message):
    """The guard's verdict. `source` is the command source in charge ("nav", "teleop" or empty).

    `stopped`: when the state was last stopped or fault, also before a restart of the guard; 0: never.
    """

    state: Annotated[GuardState, Unit("1")]
    source: Text
    reason: Text
    detail: Text
    speed_limit: Speed
    stopped: Stamp = 0


# --- what people may watch ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Costmap(Message):
    """What local control steers by, in `odom`, or the planner's costs, in `map`, while somebody watches.

    Row 0 is lowest, (x, y) its lower left corner.
    100 occupied, 99 nearer to it than the robot is wide, less with distance; 0 free, -1 unknown.
    """

    x: Metres
    y: Metres
    resolution: Annotated[float, Unit("m/cell"), Within(0.005, 1)]
    cells: Annotated[Int8s, Unit("percent, -1 unknown"), Shape("r c"), Within(-1, 100)]


@dataclass(frozen=True, slots=True)
class Rollouts(Message):
    """Ways that local control weighed up in a tick, in `odom`, while somebody watches; the first is the one it took."""

    xs: Annotated[Float32s, Unit("m"), Shape("k n"), Within(-1e6, 1e6)]
    ys: Annotated[Float32s, Unit("m"), Shape("k n"), Within(-1e6, 1e6)]
    costs: Annotated[Float32s, Unit("1"), Shape("k"), Within(0, 1e12)]


@dataclass(frozen=True, slots=True)
class MovingObstacles(Message):
    """Discs that local control takes for moving obstacles, in `odom`, while somebody watches. None: nothing moves."""

    xs: Annotated[Float32s, Unit("m"), Shape("k"), Within(-1e6, 1e6)]
    ys: Annotated[Float32s, Unit("m"), Shape("k"), Within(-1e6, 1e6)]
    vxs: Annotated[Float32s, Unit("m/s"), Shape("k"), Within(-20, 20)]
    vys: Annotated[Float32s, Unit("m/s"), Shape("k"), Within(-20, 20)]
    radii: Annotated[Float32s, Unit("m"), Shape("k"), Within(0, 100)]


@dataclass(frozen=True, slots=True)
class KeyframeGraph(Message):
    """Keyframes of the mapper in `map`, and the loop closures between them, while somebody watches.

    from_xs, from_ys, to_xs, to_ys: where the two keyframes of each closure are. accepted: 0 where the optimization
    rejects the closure.
    """

    xs: Annotated[Float32s, Unit("m"), Shape("n"), Within(-1e6, 1e6)]
    ys: Annotated[Float32s, Unit("m"), Shape("n"), Within(-1e6, 1e6)]
    from_xs: Annotated[Float32s, Unit("m"), Shape("k"), Within(-1e6, 1e6)]
    from_ys: Annotated[Float32s, Unit("m"), Shape("k"), Within(-1e6, 1e6)]
    to_xs: Annotated[Float32s, Unit("m"), Shape("k"), Within(-1e6, 1e6)]
    to_ys: Annotated[Float32s, Unit("m"), Shape("k"), Within(-1e6, 1e6)]
    accepted: Annotated[Int8s, Unit("1"), Shape("k"), Within(0, 1)]


# --- several robots --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RobotIntent(Message):
    """Where a robot is, where it will be, and which part of its path it holds, for the other robots on its map.

    Robots on maps of one name share a frame. The path is the next part of the plan, point 0 beside the robot. The robot
    holds points 0 .. held - 1, and wants those up to wanted - 1. `widths` is the free passage across the path.

    The order of two robots is by priority, then the age of the task, then the name. `claim` counts what it asked for.
    `heard` are the robots that it hears. A `lost` robot holds nothing. Its pose is where it believes to be.
    """

    robot: Text
    map: Text
    map_from_base: Pose
    v: Speed
    w: TurnRate
    radius: Annotated[float, Unit("m, circumscribed"), Within(0, 100)]
    xs: Annotated[Float32s, Unit("m in map"), Shape("n"), Within(-1e6, 1e6)]
    ys: Annotated[Float32s, Unit("m in map"), Shape("n"), Within(-1e6, 1e6)]
    widths: Annotated[Float32s, Unit("m"), Shape("n"), Within(0, 1e3)]
    held: Count
    wanted: Count
    priority: Count
    since: Stamp
    claim: Count
    heard: Annotated[tuple[tuple[str, int], ...], Unit("robot, its newest claim")]
    waits_for: Annotated[tuple[str, ...], Unit("names of the robots that keep it from its next claim")]
    gives_way: Flag
    stuck: Flag
    lost: Flag = False

    def problem(self) -> str | None:
        if self.held <= self.wanted <= len(self.xs):
            return None
        return f"it holds {self.held} and wants {self.wanted} of {len(self.xs)} points"


@dataclass(frozen=True, slots=True)
class RightOfWay(Message):
    """How far this robot may drive, as far as other robots are concerned. Not `active`: none is heard on its map.

    It may drive along the points, from its place on. `whole`: to the end of its plan. It waits for the robots of
    `waits_for`. While it `gives_way` it drives to `refuge` in place of its goal. `closed` are robots that stand and do
    not move by themselves: discs for the planner. `speed_share` is below 1 where a robot fell silent on its way.
    """

    active: Flag
    xs: Annotated[Float32s, Unit("m in map"), Shape("n"), Within(-1e6, 1e6)]
    ys: Annotated[Float32s, Unit("m in map"), Shape("n"), Within(-1e6, 1e6)]
    whole: Flag
    waits_for: Annotated[tuple[str, ...], Unit("names")]
    gives_way: Flag
    refuge: Pose
    speed_share: Annotated[float, Unit("share of the top speed"), Within(0.01, 1)]
    closed_xs: Annotated[Float32s, Unit("m in map"), Shape("k"), Within(-1e6, 1e6)]
    closed_ys: Annotated[Float32s, Unit("m in map"), Shape("k"), Within(-1e6, 1e6)]
    closed_radii: Annotated[Float32s, Unit("m"), Shape("k"), Within(0, 100)]


@dataclass(frozen=True, slots=True)
class OtherRobots(Message):
    """The other robots on this robot's map as discs, at `stamp` and each `period` after it, on their paths."""

    names: Annotated[tuple[str, ...], Unit("of the robots")]
    radii: Annotated[Float32s, Unit("m"), Shape("k"), Within(0, 100)]
    period: Annotated[float, Unit("s"), Within(0.01, 10)]
    xs: Annotated[Float32s, Unit("m in map, robot by robot"), Shape("k t"), Within(-1e6, 1e6)]
    ys: Annotated[Float32s, Unit("m in map, robot by robot"), Shape("k t"), Within(-1e6, 1e6)]

    def problem(self) -> str | None:
        if len(self.names) != len(self.radii):
            return "not one disc a name"
        return "robots without a place" if len(self.names) and not self.xs.shape[1] else None


# --- stack ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RuntimeSettings(Message):
    """The settings of a service that were set while it runs; all others are as it was started with."""

    names: Annotated[tuple[str, ...], Unit("dotted, as in a robot's file")]
    values: Annotated[tuple[str, ...], Unit("YAML, one a name")]

    def problem(self) -> str | None:
        return None if len(self.names) == len(self.values) else f"{len(self.values)} values for {len(self.names)} names"


@dataclass(frozen=True, slots=True)
class Health(Message):
    """One service's second, from its own work loop: a hung service falls silent."""

    name: Text
    pid: Count
    state: Text
    events: Count
    bad_messages: Count
    dropped: Count
    intruders: Count
    last_error: Text
    cpu: Annotated[float, Unit("share of a core over the last second"), Within(0, 1000)]
    memory: Annotated[float, Unit("MB"), Within(0, 1e7)]
    handler_ms: Annotated[float, Unit("ms, slowest handler of the last second"), Within(0, 1e9)]
    rates: Annotated[tuple[tuple[str, float, float], ...], Unit("topic, Hz, age in s when handled (largest)")]
    rejected: Annotated[
        tuple[tuple[str, str, int], ...],
        Unit("key, why (old, ahead, sequence, size, content), messages since the start"),
    ] = ()


@dataclass(frozen=True, slots=True)
class LogLine(Message):
    """One line of a service's log. Levels as in Python's logging: DEBUG, INFO, WARNING, ERROR."""

    level: Text
    text: Text


@dataclass(frozen=True, slots=True)
class Journal(Message):
    """The events that a service took since its last journal, in order: see shared/runners/journal.py for `events`."""

    session: Text
    first: Count
    events: Annotated[bytes, Unit("msgpack")]


@dataclass(frozen=True, slots=True)
class Clock(Message):
    """The simulator's time; `rate` is how many simulated seconds pass in a real one."""

    rate: Annotated[float, Unit("1"), Within(0, 1e6)]


@dataclass(frozen=True, slots=True)
class RobotDiscs(Message):
    """Where the other robots of a simulated world are, as discs in the world. Only a simulator reads it."""

    x: Annotated[Float32s, Unit("m"), Shape("n"), Within(-1e6, 1e6)]
    y: Annotated[Float32s, Unit("m"), Shape("n"), Within(-1e6, 1e6)]
    radius: Annotated[Float32s, Unit("m"), Shape("n"), Within(0, 10)]


@dataclass(frozen=True, slots=True)
class Truth(Message):
    """What only the simulator knows. Never read by a service that a robot would run. `start` is `world_from_map`."""

    world_from_base: Pose
    start: Pose
    v: Speed
    w: TurnRate
    contact: Flag
    n_contacts: Count
    distance: Metres
    people_x: Annotated[Float32s, Unit("m"), Shape("p"), Within(-1e6, 1e6)]
    people_y: Annotated[Float32s, Unit("m"), Shape("p"), Within(-1e6, 1e6)]
