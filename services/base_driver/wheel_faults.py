# SPDX-License-Identifier: Apache-2.0
"""Do both wheels do as they are told? One that does not is broken, and its fault stays until a person releases it.

Both at once is rather a board that does not hear its commands: the robot stands for a moment and tries again, and only
when that comes again and again it is a fault that stays.
"""

from collections import deque

from services.base_driver.encoders import Encoders
from services.base_driver.stuck_detection import StuckConfig, StuckDetector
from services.base_driver.wheel_tracking import WheelTrackingConfig, WheelTrackingMonitor
from shared import reasons
from shared.config import Drive

WHEEL_NAMES = ("left", "right")
BOTH_LAG_DETAIL = "the left and right wheel do not follow their commands"
RETRY_PAUSE_NS = 1_000_000_000  # ns that the robot stands when both wheels fall behind
MAX_CLOCK_STEP_NS = 50_000_000  # ns by which reports may come sooner after their stamps than the one before
MAX_RETRIES, RETRY_WINDOW_NS = 2, 20_000_000_000  # as often within as many ns


class WheelFaults:
    """`code` is a reason's, empty while no fault stays; `detail` say which wheel; `at` is when, ns.

    `pause_until`, ns: both wheels fell behind, and nothing is commanded until then.
    """

    def __init__(self, stuck: StuckConfig, following: WheelTrackingConfig, drive: Drive) -> None:
        self.code = self.detail = ""
        self.at = self.pause_until = 0
        self._retries: deque[int] = deque(maxlen=MAX_RETRIES)  # ns
        self._radii = drive.left_radius, drive.right_radius
        self._turns_under = stuck.turns_under
        self._stuck = StuckDetector(stuck), StuckDetector(stuck)
        self._tracking = WheelTrackingMonitor(following), WheelTrackingMonitor(following)
        self._n_jumps = 0
        self._report_age: int | None = None  # ns, of the last report when it came

    def latch(self, code: str, detail: str, at: int) -> None:
        """The fault stands, also one from before a restart."""
        self.code, self.detail, self.at = code, detail, at

    def release(self) -> None:
        """A person has looked."""
        self.code = self.detail = ""
        self._retries.clear()
        self._reset_tracking()

    def description(self, now: int) -> str:
        """What is wrong now, in words."""
        return self.detail or (BOTH_LAG_DETAIL if self.is_pausing(now) else "")

    def is_pausing(self, now: int) -> bool:
        """Whether both wheels fell behind just now; not after the clock was set back."""
        return 0 < self.pause_until - now <= RETRY_PAUSE_NS

    def _reset_tracking(self) -> None:
        for monitor in self._tracking:
            monitor.reset()

    def _reset(self) -> None:
        self._reset_tracking()
        for monitor in self._stuck:
            monitor.reset()

    def _may_retry(self, now: int) -> bool:
        """Whether this time the robot may try again."""
        recent = [at for at in self._retries if 0 <= now - at < RETRY_WINDOW_NS]
        if len(recent) == MAX_RETRIES:
            return False
        self._retries.append(now)
        self.pause_until = now + RETRY_PAUSE_NS
        self._reset_tracking()
        return True

    def update(self, stamp: int, encoders: Encoders, commanded: tuple[float, float], now: int) -> None:
        """After a report: its stamp (ns), the wheels as counted, and the rad/s that they were told."""
        has_jumped, self._n_jumps = encoders.n_jumps != self._n_jumps, encoders.n_jumps
        if self._report_age is not None and now - stamp < self._report_age - MAX_CLOCK_STEP_NS:
            self._reset()  # the board's clock went ahead of ours: no wheel was slow meanwhile
        self._report_age = now - stamp
        stuck, lagging, any_stuck = [], [], False
        for name, angle, speed, radius, detector, tracker in zip(
            WHEEL_NAMES, (encoders.left, encoders.right), commanded, self._radii, self._stuck, self._tracking
        ):
            if has_jumped:
                tracker.reset()
            is_stuck = detector.update(stamp, angle, speed, radius)
            rim_speed = tracker.update(stamp, angle, speed, radius)
            any_stuck |= is_stuck
            if is_stuck or abs(rim_speed) < self._turns_under:
                stuck.append(name)
            elif rim_speed == rim_speed:  # not NaN: it is astray
                lagging.append(f"the {name} wheel turns at {rim_speed:.2f} m/s where {abs(speed) * radius:.2f} is told")
        if self.code or not (stuck or lagging):
            return
        if not any_stuck and all(monitor.is_behind for monitor in self._tracking) and self._may_retry(now):
            return
        if stuck:
            self.latch(reasons.WHEEL_STUCK.code, f"the {' and '.join(stuck)} wheel is commanded but does not turn", now)
        else:
            self.latch(reasons.WHEEL_ASTRAY.code, ", ".join(lagging), now)
