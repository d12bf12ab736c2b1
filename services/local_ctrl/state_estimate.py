# SPDX-License-Identifier: Apache-2.0
"""Pose and velocity of the robot, now and when the next command acts: odometry fused with the sent commands.

Commands under way bridge the delay, as in Behnke et al., "Predicting away robot control latency", RoboCup 2003. Their
models are learned; here the drive's limits are simulated. The first-order filter about this prediction is our own.
"""

from collections import deque

from services.local_ctrl.rollout import Limits, Motion, SentCommand, predicted_motion
from shared.geometry import Pose2
from shared.messages import Odometry
from shared.types import NS_PER_S

MAX_FUSED_GAP_S = 0.5  # a longer gap of odometry resets the estimate to the measurement
MAX_COMMANDS = 64  # 3.2 s at 20 Hz, over six times the longest latency


class StateEstimate:
    """Motion in `odom` at the last odometry, and its prediction by the commands that are under way."""

    def __init__(self, limits: Limits, latency: float, settling_time: float) -> None:
        """latency: s from sending a command until the base acts. settling_time: s, time constant of the fusion."""
        self.limits, self.settling_time = limits, settling_time
        self._latency_ns = int(latency * NS_PER_S)
        self.motion = Motion(Pose2(), 0.0, 0.0)  # at the last odometry
        self._stamp = 0  # ns, of `motion`
        self._commands: deque[SentCommand] = deque(maxlen=MAX_COMMANDS)

    def add_command(self, stamp: int, v: float, w: float) -> None:
        """Registers a command (m/s, rad/s) sent at `stamp`, ns."""
        self._commands.append(SentCommand(stamp, v, w))

    def add_odometry(self, odometry: Odometry, before: Odometry | None) -> None:
        """Fuses the newest odometry. before: the message that it continues; None at the start and after a restart.

        Wheel speeds come in whole encoder counts, so a first-order filter joins them with the predicted speeds.
        """
        elapsed = (odometry.stamp - before.stamp) / NS_PER_S if before is not None else 0.0
        if before is None or elapsed > MAX_FUSED_GAP_S:
            self.motion = Motion(odometry.odom_from_base, odometry.v, odometry.w)
        else:
            prediction = self._predicted(before.stamp, odometry.stamp)
            gain = elapsed / (elapsed + self.settling_time)
            v = prediction.v + gain * (odometry.v - prediction.v)
            w = prediction.w + gain * (odometry.w - prediction.w)
            self.motion = Motion(odometry.odom_from_base, v, w)
        self._stamp = odometry.stamp
        while len(self._commands) > 1 and self._commands[1].sent + self._latency_ns <= self._stamp:
            self._commands.popleft()  # the next one acted already

    def at_command_time(self, now: int) -> Motion:
        """The predicted motion at the time when a command that is sent at `now` (ns) acts."""
        return self._predicted(self._stamp, now + self._latency_ns)

    def _predicted(self, since: int, until: int) -> Motion:
        return predicted_motion(self.motion, self.limits, list(self._commands), since, until, self._latency_ns)
