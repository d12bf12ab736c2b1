# SPDX-License-Identifier: Apache-2.0
"""The robot's hardware as configured: outline, drive and sensors. shared/config.py reads it from a robot's file."""

from math import cos, hypot, pi
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from shared.polygon import signed_area, signed_distances
from shared.section import Section

CIRCLE_CORNERS = 32  # of the polygon around a round robot: it reaches 0.5 % beyond the circle
MAX_LASERS = 2  # one topic each: shared/lasers.py
MAX_COUNTS_PER_S = 1e6  # counts/s; bound of MotorCommand and BoardReport
HOLONOMIC = ("mecanum", "omni", "omnidirectional", "holonomic", "swerve")


class Mount(Section):
    """Where a sensor sits on the robot: `base_from_sensor`."""

    x: float = Field(0.0, ge=-5, le=5, description="m ahead of the wheel axis")
    y: float = Field(0.0, ge=-5, le=5, description="m to the left of the centre line")
    yaw: float = Field(0.0, ge=-2 * pi, le=2 * pi, description="rad, counter-clockwise")


class Drive(Section):
    """The differential drive."""

    kind: Literal["differential", "velocity"] = Field(
        "differential",
        description="differential: two wheels with encoders; velocity: the base controls its own speed and does its "
        "own odometry, as messages `hardware/velocity` and `hardware/odometry` or as a board",
    )
    wheel_radius: float = Field(gt=0, le=1, description="m, mean of both")
    wheel_radius_ratio: float = Field(1.0, ge=0.8, le=1.25, description="right wheel's radius over the left one's")
    wheel_distance: float = Field(
        gt=0, le=3, description="m between the wheels' contact points, as it acts when turning"
    )
    counts_per_turn: int = Field(
        gt=0, description="encoder counts a turn of the wheel; at most 1e6 a second at the maximum speeds"
    )
    encoder_wrap: int = Field(gt=0, description="encoder counts at which the counter returns to 0")
    motor_direction: int = Field(1, ge=-1, le=1, description="+1 or -1: sign of both motors, the document's motorDir")
    max_speed: float = Field(gt=0, le=10, description="m/s forward")
    max_reverse_speed: float = Field(0.0, ge=0, le=10, description="m/s backward; 0 forbids reversing")
    max_turn_rate: float = Field(gt=0, le=20, description="rad/s")
    max_acceleration: float = Field(gt=0, le=20, description="m/s^2")
    max_braking: float = Field(gt=0, le=20, description="m/s^2 that the base really reaches")
    max_turn_acceleration: float = Field(gt=0, le=100, description="rad/s^2")
    min_turning_radius: float = Field(0.0, ge=0, le=20, description="m: of the tightest arc that it drives; 0: any")
    turns_in_place: bool = Field(True, description="it may turn on the spot; if not, give min_turning_radius")

    @field_validator("kind", mode="before")
    @classmethod
    def _not_holonomic(cls, value: Any) -> Any:
        if value in HOLONOMIC:
            raise ValueError("a holonomic base cannot be driven: zenav plans for bases that drive forward and turn")
        return value

    @model_validator(mode="after")
    def _drivable(self) -> "Drive":
        if self.motor_direction == 0:
            raise ValueError("motor_direction is +1 or -1")
        if not self.turns_in_place and self.min_turning_radius < 0.05:
            raise ValueError("a robot that may not turn on the spot needs a min_turning_radius of 0.05 m at least")
        return self

    @model_validator(mode="after")
    def _countable(self) -> "Drive":
        """The bound of MotorCommand: a faster command would be rejected, and a faster report too."""
        rim_speed = max(self.max_speed, self.max_reverse_speed) + self.max_turn_rate * self.wheel_distance / 2
        counts = rim_speed / min(self.left_radius, self.right_radius) * self.counts_per_turn / (2 * pi)
        if self.kind == "differential" and counts > MAX_COUNTS_PER_S:
            raise ValueError(
                f"counts_per_turn: at its maximum speeds a wheel makes {counts:.0f} counts a second; the limit is "
                f"{MAX_COUNTS_PER_S:.0f}"
            )
        return self

    @property
    def left_radius(self) -> float:
        """m; the two have `wheel_radius` as their mean: Borenstein and Feng 1996, equations 13 and 14."""
        return 2 * self.wheel_radius / (1 + self.wheel_radius_ratio)

    @property
    def right_radius(self) -> float:
        """m"""
        return self.left_radius * self.wheel_radius_ratio

    def clamped(self, v: float, w: float) -> tuple[float, float]:
        """The velocity (m/s, rad/s) scaled down, on its own arc, until it is within the limits.

        An arc tighter than the robot's is opened to that.
        """
        limit = self.max_speed if v >= 0 else self.max_reverse_speed
        w = self.bent(v, w)
        share = min(1.0, limit / abs(v) if v else 1.0, self.max_turn_rate / abs(w) if w else 1.0)
        return v * share, w * share

    def bent(self, v: float, w: float) -> float:
        """The turn rate, rad/s, that is nearest to w at a speed of v m/s and on an arc that the robot drives."""
        if not self.min_turning_radius or (v == 0 and self.turns_in_place):
            return w
        max_turn_rate = abs(v) / self.min_turning_radius
        return min(max(w, -max_turn_rate), max_turn_rate)


class Laser(Section):
    """A laser: its mount and its sweep, in its own frame."""

    name: str = Field(
        "", pattern="^([a-z][a-z0-9_]*)?$", description="its own in `robot.lasers`; a single laser needs none"
    )
    mapping: bool = Field(True, description="the mapper uses it; true for the first laser")
    mount: Mount = Mount()
    angle_min: float = Field(ge=-2 * pi, le=2 * pi, description="rad, first beam")
    angle_increment: float = Field(ge=-pi, le=pi, description="rad between beams; negative: clockwise")
    n_beams: int = Field(ge=2, le=20000, description="beams a sweep")
    scan_time: float = Field(ge=0, le=2, description="s from the first to the last beam")
    rate: float = Field(gt=0, le=200, description="sweeps a second")
    range_min: float = Field(ge=0, description="m; nearer is no measurement")
    range_max: float = Field(gt=0, le=250, description="m; farther is no echo")

    @model_validator(mode="after")
    def _measures(self) -> "Laser":
        """The rules of `LaserScan.problem`: no scan of another laser would count."""
        if self.angle_increment == 0:
            raise ValueError("angle_increment is not 0: it is the angle between two beams")
        if abs(self.angle_increment) * (self.n_beams - 1) > 2 * pi + 1e-3:
            raise ValueError("n_beams * angle_increment is more than a full turn")
        if self.range_min >= self.range_max:
            raise ValueError("range_min is under range_max")
        return self


class RangeSensor(Section):
    """One ultrasonic or infrared sensor."""

    kind: str = Field(pattern="^(ultrasonic|infrared)$", description="ultrasonic or infrared")
    mount: Mount
    field_of_view: float = Field(gt=0, le=2 * pi, description="rad, whole cone")
    range_min: float = Field(ge=0, description="m")
    range_max: float = Field(gt=0, description="m")


class ImuMount(Section):
    """How an inertial sensor sits on the robot. Its place does not matter for the turn rate."""

    yaw: float = Field(0.0, ge=-2 * pi, le=2 * pi, description="rad, of its x axis, counter-clockwise seen from above")
    upside_down: bool = Field(False, description="its z axis points down; `yaw` is still of its x axis")


class Bumper(Section):
    """A bumper: a sector of the outline, seen from the origin of `base`."""

    name: str = Field(min_length=1, description="its own among the bumpers; the driver's name for it")
    bearing: float = Field(ge=-2 * pi, le=2 * pi, description="rad, of the sector's middle, counter-clockwise")
    width: float = Field(gt=0, le=2 * pi, description="rad, of the sector")


class CliffSensor(Section):
    """A sensor that looks down for the floor."""

    name: str = Field(min_length=1, description="its own among the cliff sensors; the driver's name for it")
    x: float = Field(ge=-5, le=5, description="m ahead of the wheel axis")
    y: float = Field(ge=-5, le=5, description="m to the left of the centre line")


class Robot(Section):
    """The robot's hardware. Every service may read it."""

    name: str = Field(pattern="^[a-z][a-z0-9_]*$", description="first part of every key")
    footprint: tuple[tuple[float, float], ...] = Field(
        (), description="m, corners in `base`, counter-clockwise, three at least; or give `radius`"
    )
    radius: float | None = Field(None, gt=0, le=5, description="m: of a round robot about `base`; or give `footprint`")
    drive: Drive
    lasers: tuple[Laser, ...] = Field(
        (), max_length=MAX_LASERS, description="its lasers, the mapper's first; or give one as `laser`"
    )
    laser: Laser
    ranges: tuple[RangeSensor, ...] = Field((), description="ultrasonic and infrared sensors, in the board's order")
    imu: ImuMount | None = Field(None, description="its inertial sensor; none: odometry is of the wheels alone")
    bumpers: tuple[Bumper, ...] = Field((), description="its bumpers")
    cliffs: tuple[CliffSensor, ...] = Field((), description="its cliff sensors")
    estop_input: bool = Field(False, description="its board has an input for an e-stop button")

    @model_validator(mode="before")
    @classmethod
    def _first_laser(cls, values: Any) -> Any:
        """`laser` is the first of `lasers`."""
        if isinstance(values, dict) and "laser" not in values and isinstance(values.get("lasers"), list | tuple):
            return values | ({"laser": values["lasers"][0]} if values["lasers"] else {})
        return values

    @model_validator(mode="after")
    def _around_the_origin(self) -> "Robot":
        if bool(self.footprint) == (self.radius is not None):
            raise ValueError("give either footprint, as corners, or radius")
        if self.radius is None and len(self.footprint) < 3:
            raise ValueError("footprint: three corners at least")
        corners = self.corners
        if signed_area(corners) <= 0:
            raise ValueError("footprint: corners must run counter-clockwise and enclose an area")
        if not np.all(np.hypot(*(np.roll(corners, -1, axis=0) - corners).T) > 1e-6):
            raise ValueError("footprint: a corner repeats its neighbour; the outline closes by itself")
        if self.inscribed_radius <= 0:
            raise ValueError("footprint: the origin of `base` must lie inside")
        return self

    @model_validator(mode="after")
    def _without_ranges(self) -> "Robot":
        if self.drive.kind == "velocity" and self.ranges:
            raise ValueError("ranges: a base of drive.kind velocity sends no ranges")
        return self

    @model_validator(mode="after")
    def _named_once(self) -> "Robot":
        for kind, names in (("bumpers", [b.name for b in self.bumpers]), ("cliffs", [c.name for c in self.cliffs])):
            if len(set(names)) < len(names):
                raise ValueError(f"{kind}: each has a name of its own")
        return self

    @model_validator(mode="after")
    def _lasers(self) -> "Robot":
        names = [laser.name for laser in self.lasers]
        if not names:
            return self
        if self.laser != self.lasers[0]:
            raise ValueError("lasers: give either laser or lasers, and not both")
        if "" in names or len(set(names)) < len(names):
            raise ValueError("lasers: each has a name of its own")
        if not self.lasers[0].mapping:
            raise ValueError(
                "lasers: the mapper always uses the first laser; set its `mapping` to true, or list it second"
            )
        return self

    @property
    def all_lasers(self) -> tuple[Laser, ...]:
        """All lasers, `laser` first."""
        return self.lasers or (self.laser,)

    @property
    def laser_2(self) -> Laser:
        """The second one of `lasers`. Raises IndexError where there is none."""
        return self.lasers[1]

    @property
    def mapping_lasers(self) -> tuple[Laser, ...]:
        """The lasers that the mapper uses, `laser` first."""
        return self.laser, *(laser for laser in self.all_lasers[1:] if laser.mapping)

    @property
    def has_contacts(self) -> bool:
        """Whether the board reports contacts: bumpers, cliff sensors or an e-stop input."""
        return bool(self.bumpers or self.cliffs or self.estop_input)

    @property
    def corners(self) -> NDArray[np.float64]:
        """(n, 2) m, in `base`, counter-clockwise; of a round robot, the regular polygon around the circle."""
        if self.radius is None:
            return np.array(self.footprint, float)
        angles = 2 * pi * (np.arange(CIRCLE_CORNERS) + 0.5) / CIRCLE_CORNERS
        return self.radius / cos(pi / CIRCLE_CORNERS) * np.column_stack((np.cos(angles), np.sin(angles)))

    @property
    def inscribed_radius(self) -> float:
        """m: the largest circle about `base` inside the footprint (negative when base lies outside)."""
        return -float(signed_distances(self.corners, np.zeros((1, 2)))[0])

    @property
    def circumscribed_radius(self) -> float:
        """m: the smallest circle about `base` around the footprint."""
        return max(hypot(x, y) for x, y in self.corners.tolist())
