# SPDX-License-Identifier: Apache-2.0
"""Do both wheels follow their commands? A fault of one wheel is latched until an e-stop release.

If both wheels fall behind at once, the board probably misses commands. The robot stops for RETRY_PAUSE_NS and tries
again. More than MAX_RETRIES within RETRY_WINDOW_NS are a latched fault.
"""

from collections import deque

from services.base_driver.encoders import WheelAngles
from services.base_driver.stuck_detection import StuckConfig, StuckDetector
from services.base_driver.wheel_tracking import WheelTrackingConfig, WheelTrackingMonitor
from shared import reasons
from shared.config import Drive

WHEEL_NAMES = ("left", "right")
BOTH_LAG_DETAIL = "the left and right wheel do not follow their commands"
RETRY_PAUSE_NS = 1_000_000_000  # pause when both wheels fall behind
MAX_CLOCK_STEP_NS = 50_000_000  # maximum decrease of the reports' age from one to the next
MAX_RETRIES, RETRY_WINDOW_NS = 2, 20_000_000_000  # retries within this window, ns


class WheelFaults:
    """`code`: reason of the latched fault, empty without one; `detail`: which wheel; `at`: its time, ns.

    `pause_until`: ns, end of the pause after both wheels fell behind.
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
        self._epoch: int | None = None
        self._report_age: int | None = None  # ns, of the last report when it came

    def latch(self, code: str, detail: str, at: int) -> None:
        """Latches a fault, also one from before a restart; at: ns."""
        self.code, self.detail, self.at = code, detail, at

    def release(self) -> None:
        """Ends the fault, after an e-stop release."""
        self.code = self.detail = ""
        self._retries.clear()
        self._reset_tracking()

    def description(self, now: int) -> str:
        """Text of the present fault; empty without one."""
        return self.detail or (BOTH_LAG_DETAIL if self.is_pausing(now) else "")

    def is_pausing(self, now: int) -> bool:
        """Whether the robot pauses because both wheels fell behind; False after the clock was set back."""
        return 0 < self.pause_until - now <= RETRY_PAUSE_NS

    def _reset_tracking(self) -> None:
        for monitor in self._tracking:
            monitor.reset()

    def restart(self) -> None:
        """The wheel angles began again: the next report is compared with none before."""
        self._reset_tracking()
        for monitor in self._stuck:
            monitor.reset()

    def _may_retry(self, now: int) -> bool:
        """Begins a pause and returns True, unless MAX_RETRIES are used up."""
        recent = [at for at in self._retries if 0 <= now - at < RETRY_WINDOW_NS]
        if len(recent) == MAX_RETRIES:
            return False
        self._retries.append(now)
        self.pause_until = now + RETRY_PAUSE_NS
        self._reset_tracking()
        return True

    def update(self, stamp: int, encoders: WheelAngles, commanded: tuple[float, float], now: int) -> None:
        """Judges a report: its stamp (ns), the wheel angles, and the commanded speeds (left, right, rad/s)."""
        is_continuous = (encoders.n_jumps, encoders.epoch) == (self._n_jumps, self._epoch)
        self._n_jumps, self._epoch = encoders.n_jumps, encoders.epoch
        if self._report_age is not None and now - stamp < self._report_age - MAX_CLOCK_STEP_NS:
            self.restart()  # the board's clock was ahead: the wheels were not slow
        self._report_age = now - stamp
        stuck, lagging, any_stuck = [], [], False
        for name, angle, speed, radius, detector, tracker in zip(
            WHEEL_NAMES, (encoders.left, encoders.right), commanded, self._radii, self._stuck, self._tracking
        ):
            if not is_continuous:
                tracker.reset()
            is_stuck = detector.update(stamp, angle, speed, radius)
            rim_speed = tracker.update(stamp, angle, speed, radius)
            any_stuck |= is_stuck
            if is_stuck or abs(rim_speed) < self._turns_under:
                stuck.append(name)
            elif rim_speed == rim_speed:  # not NaN: the wheel does not follow
                lagging.append(f"the {name} wheel turns at {rim_speed:.2f} m/s where {abs(speed) * radius:.2f} is told")
        if self.code or not (stuck or lagging):
            return
        both_lag = not any_stuck and all(monitor.was_behind for monitor in self._tracking)
        if both_lag and self._may_retry(now):
            return
        code = reasons.WHEEL_STUCK.code if stuck else reasons.WHEEL_ASTRAY.code
        if both_lag:  # one of them is over the limit first
            self.latch(code, f"{BOTH_LAG_DETAIL}, also after {MAX_RETRIES} pauses", now)
        elif stuck:
            self.latch(code, f"the {' and '.join(stuck)} wheel is commanded but does not turn", now)
        else:
            self.latch(code, ", ".join(lagging), now)
