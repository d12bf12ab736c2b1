# SPDX-License-Identifier: Apache-2.0
"""Do both wheels do as they are told? One that does not is broken, and its fault stays until a person releases it.

Both at once is rather a board that does not hear its commands: the robot stands for a moment and tries again, and only
when that comes again and again it is a fault that stays.
"""

from collections import deque

from services.base_driver.encoders import Encoders
from services.base_driver.following import FollowingConfig, FollowWatch
from services.base_driver.stuck import StuckConfig, StuckWatch
from shared import reasons
from shared.config import Drive

NAMES = ("left", "right")
BOTH = "the left and right wheel do not follow their commands"
PAUSE = 1_000_000_000  # ns that the robot stands when both wheels fall behind
MAX_CLOCK_STEP = 50_000_000  # ns by which reports may come sooner after their stamps than the one before
PARDONS, PARDONED_FOR = 2, 20_000_000_000  # as often within as many ns


class WheelFaults:
    """`code` is a reason's, empty while no fault stays; `words` say which wheel; `at` is when, ns.

    `stands_until`, ns: both wheels fell behind, and nothing is commanded until then.
    """

    def __init__(self, stuck: StuckConfig, following: FollowingConfig, drive: Drive) -> None:
        self.code = self.words = ""
        self.at = self.stands_until = 0
        self._pardons: deque[int] = deque(maxlen=PARDONS)  # ns
        self._radii = drive.left_radius, drive.right_radius
        self._turns_under = stuck.turns_under
        self._stuck = StuckWatch(stuck), StuckWatch(stuck)
        self._follow = FollowWatch(following), FollowWatch(following)
        self._n_jumps = 0
        self._age: int | None = None  # ns, of the last report when it came

    def latch(self, code: str, words: str, at: int) -> None:
        """The fault stands, also one from before a restart."""
        self.code, self.words, self.at = code, words, at

    def release(self) -> None:
        """A person has looked."""
        self.code = self.words = ""
        self._pardons.clear()
        self._forget()

    def told(self, now: int) -> str:
        """What is wrong now, in words."""
        return self.words or (BOTH if self.pausing(now) else "")

    def pausing(self, now: int) -> bool:
        """Whether both wheels fell behind just now; not after the clock was set back."""
        return 0 < self.stands_until - now <= PAUSE

    def _forget(self) -> None:
        for watch in self._follow:
            watch.forget()

    def _restart(self) -> None:
        self._forget()
        for watch in self._stuck:
            watch.forget()

    def _pardoned(self, now: int) -> bool:
        """Whether this time the robot may try again."""
        recent = [at for at in self._pardons if 0 <= now - at < PARDONED_FOR]
        if len(recent) == PARDONS:
            return False
        self._pardons.append(now)
        self.stands_until = now + PAUSE
        self._forget()
        return True

    def look(self, stamp: int, encoders: Encoders, commanded: tuple[float, float], now: int) -> None:
        """After a report: its stamp (ns), the wheels as counted, and the rad/s that they were told."""
        jumped, self._n_jumps = encoders.n_jumps != self._n_jumps, encoders.n_jumps
        if self._age is not None and now - stamp < self._age - MAX_CLOCK_STEP:
            self._restart()  # the board's clock went ahead of ours: no wheel was slow meanwhile
        self._age = now - stamp
        stuck, astray, stood = [], [], False
        for name, angle, speed, radius, stuck_watch, follow_watch in zip(
            NAMES, (encoders.left, encoders.right), commanded, self._radii, self._stuck, self._follow
        ):
            if jumped:
                follow_watch.forget()
            stands = stuck_watch.stuck(stamp, angle, speed, radius)
            at_rim = follow_watch.astray(stamp, angle, speed, radius)
            stood |= stands
            if stands or abs(at_rim) < self._turns_under:
                stuck.append(name)
            elif at_rim == at_rim:  # not NaN: it is astray
                astray.append(f"the {name} wheel turns at {at_rim:.2f} m/s where {abs(speed) * radius:.2f} is told")
        if self.code or not (stuck or astray):
            return
        if not stood and all(watch.behind for watch in self._follow) and self._pardoned(now):
            return
        if stuck:
            self.latch(reasons.WHEEL_STUCK.code, f"the {' and '.join(stuck)} wheel is commanded but does not turn", now)
        else:
            self.latch(reasons.WHEEL_ASTRAY.code, ", ".join(astray), now)
