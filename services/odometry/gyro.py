# SPDX-License-Identifier: Apache-2.0
"""Heading by gyro: its bias from the times when the robot stands, its turn between two wheel messages, and wheel slip.

Borenstein and Feng 1996 ("Gyrodometry") use the gyro only where both sources disagree. Here the gyro always gives the
turn: without its bias it is the better one. The bias is a scalar Kalman filter over standstills; that is our own.
"""

from dataclasses import dataclass
from math import exp

from pydantic import Field

from shared.config import Section
from shared.messages import Imu

SETTLING_S = 0.3  # after the wheels stopped: the body still sways
BIAS_SAMPLES = 25  # of one measurement of the bias, at least
SLIP_TIME_S = 0.3  # over which gyro and wheels are compared


class GyroConfig(Section):
    """Heading by gyro."""

    use: bool = Field(True, description="whether readings of `imu` give the heading; if not, the wheels do")
    max_age: float = Field(
        0.06, gt=0, le=1, description="s without a reading at which the wheels give the heading again"
    )
    bias_time: float = Field(1.0, ge=0.2, le=60, description="s of standstill that measure the bias once")
    max_bias: float = Field(0.15, gt=0, le=5, description="rad/s; a larger mean at standstill is a motion")
    quiet: float = Field(
        0.04, gt=0, le=1, description="rad/s between the readings of a standstill at most; more is a motion"
    )
    drift: float = Field(
        3e-5, gt=0, le=0.1, description="rad/s for each square root of a second by which the bias walks"
    )
    yaw_variance: float = Field(
        1e-5, ge=0, le=1, description="variance of the heading, rad^2, for each second of motion"
    )
    turn_variance: float = Field(
        5e-4, ge=0, le=1, description="variance of the heading, rad^2, for each rad of turn: the gyro's scale"
    )
    slip_rate: float = Field(
        0.2, gt=0, le=10, description="rad/s between gyro and wheels from which the wheels slip, beside `slip_share`"
    )
    slip_share: float = Field(0.2, ge=0, le=2, description="share of the turn rate by which both may differ")


@dataclass(slots=True)
class _Standstill:
    """Readings while the wheels stand. since: ns; angles: rad, of both wheels at its begin."""

    since: int
    angles: tuple[float, float]
    n: int = 0
    total: float = 0.0
    squares: float = 0.0
    low: float = 0.0
    high: float = 0.0
    begin: int = 0  # ns of the first reading


class Gyro:
    """The gyro's turn, without its bias. Rates are rad/s, positive counter-clockwise; stamps are ns."""

    def __init__(self, config: GyroConfig) -> None:
        self.config = config
        self.bias: float | None = None  # rad/s; None before the first standstill
        self.rate = 0.0  # rad/s, of the last reading, without the bias
        self.stamp: int | None = None  # of the last reading
        self._variance = 0.0  # (rad/s)^2, of the bias
        self._measured_at = 0  # ns, of the bias
        self._turned = 0.0  # rad since the start, without the bias
        self._used: float | None = None  # the part of it that the heading has
        self._standstill: _Standstill | None = None
        self._difference = 0.0  # rad, leaky sum of gyro minus wheels

    def add(self, imu: Imu) -> None:
        """Takes a reading, which is newer than the last one."""
        before, self.stamp = self.stamp, imu.stamp
        self._watch_bias(imu)
        self.rate = imu.yaw_rate - (self.bias or 0.0)
        seconds = 0.0 if before is None else (imu.stamp - before) * 1e-9
        if not 0 <= seconds <= self.config.max_age:
            self._used = None  # what it did in the gap is unknown
        elif not self._rests:
            self._turned += self.rate * seconds

    def watch_wheels(self, stamp: int, left: float, right: float, tolerance: tuple[float, float]) -> None:
        """Takes the wheels' angles (rad), by which it knows a standstill. tolerance: rad, of each wheel."""
        stand = self._standstill
        moved = stand is None or any(
            abs(now - before) > most for now, before, most in zip((left, right), stand.angles, tolerance, strict=True)
        )
        if moved or stand is None or stamp < stand.since:
            self._standstill = _Standstill(stamp, (left, right))

    def turn_until(self, stamp: int) -> float | None:
        """The turn (rad) since the last call, up to a wheel message's stamp; None while the gyro cannot be used.

        Between readings it goes on with the last rate; the next call corrects that.
        """
        if self.bias is None or self.stamp is None:
            return None
        ahead = (stamp - self.stamp) * 1e-9
        if abs(ahead) > self.config.max_age:
            self._used = None
            return None
        turned = self._turned + (0.0 if self._rests else self.rate * ahead)
        before, self._used = self._used, turned
        return None if before is None else turned - before

    def skip_turn(self) -> None:
        """Drops the turn since the last call of `turn_until`."""
        self._used = None

    def is_slipping(self, gyro: float, wheels: float, seconds: float) -> bool:
        """Whether turns of gyro and wheels (rad) in the last `seconds` and shortly before disagree."""
        self._difference = self._difference * exp(-seconds / SLIP_TIME_S) + gyro - wheels
        limit = self.config.slip_rate + self.config.slip_share * abs(gyro) / max(seconds, 1e-3)
        return abs(self._difference) / SLIP_TIME_S > limit

    @property
    def _rests(self) -> bool:
        """Whether the wheels stand and the gyro is quiet: then the heading does not walk by its noise."""
        stand = self._standstill
        return stand is not None and stand.n > 0 and abs(self.rate) < self.config.quiet

    def _watch_bias(self, imu: Imu) -> None:
        """Adds a reading at standstill, and takes the bias of a whole measurement."""
        stand = self._standstill
        if stand is None or not (imu.stamp - stand.since) * 1e-9 >= SETTLING_S:
            return
        rate = imu.yaw_rate
        if stand.n == 0:
            stand.begin, stand.low, stand.high = imu.stamp, rate, rate
        stand.n, stand.total, stand.squares = stand.n + 1, stand.total + rate, stand.squares + rate * rate
        stand.low, stand.high = min(stand.low, rate), max(stand.high, rate)
        if stand.high - stand.low > self.config.quiet or abs(rate) > self.config.max_bias:
            self._standstill = _Standstill(imu.stamp, stand.angles)  # it is turned: no measurement
        elif stand.n >= BIAS_SAMPLES and (imu.stamp - stand.begin) * 1e-9 >= self.config.bias_time:
            mean = stand.total / stand.n
            variance = max(stand.squares / stand.n - mean * mean, 1e-12) / stand.n
            self._correct_bias(imu.stamp, mean, variance)
            stand.n, stand.total, stand.squares, stand.begin = 1, rate, rate * rate, imu.stamp
            stand.low = stand.high = rate

    def _correct_bias(self, stamp: int, measured: float, variance: float) -> None:
        """A step of the filter: a measured bias (rad/s) with its variance."""
        if self.bias is None:
            self.bias, self._variance = measured, variance
        else:
            walked = self._variance + self.config.drift**2 * max(stamp - self._measured_at, 0) * 1e-9
            gain = walked / (walked + variance)
            self.bias += gain * (measured - self.bias)
            self._variance = (1 - gain) * walked
        self._measured_at = stamp
