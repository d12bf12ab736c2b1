# SPDX-License-Identifier: Apache-2.0
"""Do both wheels do as they are told? The first fault stays, with its words, until a person releases it."""

from services.base_driver.encoders import Encoders
from services.base_driver.following import FollowingConfig, FollowWatch
from services.base_driver.stuck import StuckConfig, StuckWatch
from shared import reasons
from shared.config import Drive

NAMES = ("left", "right")


class WheelFaults:
    """`code` is a reason's, empty while there is no fault; `words` say which wheel; `at` is when, ns."""

    def __init__(self, stuck: StuckConfig, following: FollowingConfig, drive: Drive) -> None:
        self.code = self.words = ""
        self.at = 0
        self._radii = drive.left_radius, drive.right_radius
        self._turns_under = stuck.turns_under
        self._stuck = StuckWatch(stuck), StuckWatch(stuck)
        self._follow = FollowWatch(following), FollowWatch(following)
        self._n_jumps = 0

    def latch(self, code: str, words: str, at: int) -> None:
        """The fault stands, also one from before a restart."""
        self.code, self.words, self.at = code, words, at

    def release(self) -> None:
        """A person has looked."""
        self.code = self.words = ""
        for watch in self._follow:
            watch.forget()

    def look(self, stamp: int, encoders: Encoders, commanded: tuple[float, float], now: int) -> None:
        """After a report: its stamp (ns), the wheels as counted, and the rad/s that they were told."""
        jumped, self._n_jumps = encoders.n_jumps != self._n_jumps, encoders.n_jumps
        stuck, astray = [], []
        for name, angle, speed, radius, stuck_watch, follow_watch in zip(
            NAMES, (encoders.left, encoders.right), commanded, self._radii, self._stuck, self._follow
        ):
            if jumped:
                follow_watch.forget()
            stands = stuck_watch.stuck(stamp, angle, speed, radius)
            at_rim = follow_watch.astray(stamp, angle, speed, radius)
            if stands or abs(at_rim) < self._turns_under:
                stuck.append(name)
            elif at_rim == at_rim:  # not NaN: it is astray
                astray.append(f"the {name} wheel turns at {at_rim:.2f} m/s where {abs(speed) * radius:.2f} is told")
        if self.code:
            return
        if stuck:
            self.latch(reasons.WHEEL_STUCK.code, f"the {' and '.join(stuck)} wheel is commanded but does not turn", now)
        elif astray:
            self.latch(reasons.WHEEL_ASTRAY.code, ", ".join(astray), now)
