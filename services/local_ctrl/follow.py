# SPDX-License-Identifier: Apache-2.0
"""How a plan is driven: turn towards it on the spot, follow it by a controller, stop at its end, turn as it says."""

from math import atan2, copysign, hypot, isinf, pi, sqrt

import numpy as np
from pydantic import Field

from services.local_ctrl.controller import APPROACH, Controller, Scene
from services.local_ctrl.distance_to_go import DistanceToGoConfig, distance_to_go
from services.local_ctrl.expected import expected
from services.local_ctrl.footprint import Float64s, Footprint, sampled
from services.local_ctrl.local_costmap import LocalCostmap
from services.local_ctrl.local_plan import LEAP, SPACING, Ahead, LocalPlan, until_turned
from services.local_ctrl.manoeuvres import TURN_LOOK, Outcome, braking, free_turn, turn_command
from services.local_ctrl.rollout import DT, Limits, Motion, speed_after
from services.local_ctrl.zones import LocalZones
from shared import reasons
from shared.config import Section
from shared.geometry import Pose2, wrapped
from shared.messages import FollowState, Goal

SLOW = 0.05  # m/s
BRAKING_ROOM = 0.3  # m
ARC_LEAP = 2.0  # radii along the path within which who drives in arcs is looked for: not across a loop
ARC_AHEAD = 1.9  # rad that the path ahead turns at most, for who drives in arcs
BEYOND = 1.5  # radii beyond the goal that who cannot turn there steers for
CREEP = 0.06  # m/s
DOCKING = 0.6  # m/s a metre before a goal at which it cannot turn: slow enough to come to its heading
BESIDE_ARCS = 4.0  # slowness a metre beside the plan, and at most, for who drives in arcs
NOWHERE: Float64s = np.empty((0, 2))
MISSED = FollowState.FAILED, reasons.HEADING_MISSED.code
CHANGED = 0.5  # rad over half a turn that are left on the spot: the way is another by now
THREAT, THREAT_ROOM = 2.0, 0.2  # s until something would be this near, m, if the robot stood
RIM = 0.25  # m of the window that the path keeps off: the field around its end needs room


class FollowConfig(Section):
    """Following a plan."""

    turn_from: float = Field(
        1.0, ge=0.2, le=3.2, description="rad off the way at which a standing robot turns on the spot"
    )
    turn_until: float = Field(0.3, ge=0.05, le=3, description="rad off the way at which it drives on")
    turn_rate: float = Field(1.5, ge=0.1, le=10, description="rad/s at most, turning on the spot")
    look: float = Field(0.4, ge=0.1, le=3, description="m down the way that is 'the way' for turning")
    closed_within: float = Field(
        0.25, ge=0.05, le=5, description="m before the place where every way is closed at which it is called blocked"
    )
    stalled_after: float = Field(0.5, ge=0.05, le=10, description="s without a way forward until it is called blocked")


class Follower:
    """What following remembers between ticks."""

    def __init__(
        self,
        config: FollowConfig,
        to_go: DistanceToGoConfig,
        controller: Controller,
        limits: Limits,
        footprint: Footprint,
        zones: LocalZones,
    ) -> None:
        self.config, self.limits, self.footprint = config, limits, footprint
        # an arc that was planned is there for a reason: its chord is no way for who must keep it
        stays = {"beside_plan": BESIDE_ARCS, "beside_plan_at_most": BESIDE_ARCS}
        self.to_go = to_go if isinf(limits.curvature) else to_go.model_copy(update=stays)
        self.controller, self.zones = controller, zones
        self.reset()

    def reset(self) -> None:
        """The next tick starts from a stand."""
        self.controller.reset()
        self.turning = 0.0  # which way round, 0: not turning
        self.at_end = False
        self.missed = False  # the goal's heading: it stands at the plan's end and needs another plan
        self.n_stalled = 0

    def follow(
        self, plan: LocalPlan, goal: Goal, costmap: LocalCostmap, motion: Motion, odom_from_map: Pose2, n_elapsed: int
    ) -> Outcome:
        """One tick. motion: where the robot will be when the command acts, in `odom`."""
        window = costmap.resolution * len(costmap.field) / 2 - RIM
        arcs = not isinf(self.limits.curvature)
        leap = min(LEAP, max(ARC_LEAP / self.limits.curvature, 4.0 * DT * self.limits.v_max)) if arcs else LEAP
        ahead = plan.ahead(odom_from_map, motion.pose, window, leap)
        if np.abs(ahead.points[0] - (motion.pose.x, motion.pose.y)).max() > window:
            self.reset()  # nothing in sight leads there, or to anything else: the plan is one for another place
            return braking(motion, self.limits, FollowState.BLOCKED, reasons.POSE_JUMPED.code)
        left = ahead.left + hypot(ahead.points[0, 0] - motion.pose.x, ahead.points[0, 1] - motion.pose.y)
        if self._ended(ahead, goal, motion, odom_from_map, plan):
            return self._turned_to_goal(ahead.end.yaw, goal, costmap, motion)
        if not self.limits.spins and ahead.left == 0.0 and abs(self._behind(ahead, motion)) > 0.5 * pi:
            self.missed = True  # it drove past
            return braking(motion, self.limits, *MISSED)
        if arcs:
            ahead = until_turned(ahead, ARC_AHEAD)
        self.controller.limits = self.zones.limited(self.limits, ahead.points, motion, odom_from_map)
        slow = reasons.SPEED_ZONE.code if self.controller.limits.v_max < self.limits.v_max else ""
        led_on = arcs and not self.limits.spins and ahead.ends and goal.yaw_tolerance <= pi
        beyond = self._beyond(ahead, costmap) if led_on else NOWHERE
        if len(beyond):
            self.controller.limits = stopping(self.controller.limits, motion.pose.distance(ahead.end))
            ahead = ahead._replace(points=np.concatenate((ahead.points, beyond)), ends=False)
        scene, closed = self._scene(ahead, costmap, motion)
        threatened = self._threatened(scene)
        if threatened:
            self.turning = 0.0
        elif not closed and (outcome := self._turned_to_way(scene, costmap, motion, left)) is not None:
            return outcome
        solution = self.controller.solve(scene, self.footprint, n_elapsed)
        stalls = closed or (solution.gain < 0.1 and abs(solution.velocities[0, 0]) < SLOW)
        self.n_stalled = self.n_stalled + 1 if stalls and not threatened else 0
        if solution.collides or self.n_stalled * DT >= self.config.stalled_after:
            return braking(motion, self.limits, FollowState.BLOCKED, reasons.BLOCKED.code, left)
        v, w = solution.velocities[0]
        return Outcome(float(v), float(w), FollowState.FOLLOWING, slow, left)  # slow: no stop, but people ask why

    def _beyond(self, ahead: Ahead, costmap: LocalCostmap) -> Float64s:
        """(n, 2) m in `odom`: straight on from the path's end while the robot fits. Who steers for a point there
        passes the end with its heading, which who steers for the end itself does not.
        """
        along = SPACING * np.arange(1, int(BEYOND / self.limits.curvature / SPACING) + 1)
        points = ahead.end @ np.column_stack((along, np.zeros(len(along))))
        cells = (points - (costmap.x0, costmap.y0)) / costmap.resolution
        fits = [sampled(costmap.field, x, y) > self.footprint.circumscribed for x, y in cells.tolist()]
        return points[: fits.index(False) if False in fits else len(fits)]

    def _scene(self, ahead: Ahead, costmap: LocalCostmap, motion: Motion) -> tuple[Scene, bool]:
        """What the rollouts meet, and whether the robot stands where every way is closed."""
        points = ahead.points - (costmap.x0, costmap.y0)
        x, y = motion.pose.x - costmap.x0, motion.pose.y - costmap.y0
        to_go = distance_to_go(
            costmap.field,
            costmap.unknown,
            costmap.resolution,
            points,
            (x, y),
            self.footprint.inscribed,
            self.to_go,
        )
        scene = Scene(
            costmap.field,
            costmap.occupied,
            costmap.resolution,
            to_go.field,
            float(points[to_go.i_end, 0]),
            float(points[to_go.i_end, 1]),
            ahead.ends or to_go.closed,
            x,
            y,
            motion.pose.yaw,
            motion.v,
            motion.w,
            points[: to_go.i_end + 1],
            costmap.moving - (costmap.x0, costmap.y0, 0.0, 0.0, 0.0, 0.0),
        )
        return scene, to_go.closed and hypot(scene.end_x - x, scene.end_y - y) < self.config.closed_within

    def _threatened(self, scene: Scene) -> bool:
        """Whether something comes that would run into the robot if it stood: then it is no time to turn, or to wait."""
        ways = expected(scene.movers, round(THREAT / DT))
        gaps = np.hypot(ways[:, :, 0] - scene.x, ways[:, :, 1] - scene.y) - ways[:, :, 2]
        return bool((gaps < self.footprint.circumscribed + THREAT_ROOM).any())

    def _ended(self, ahead: Ahead, goal: Goal, motion: Motion, odom_from_map: Pose2, plan: LocalPlan) -> bool:
        """Whether the robot is where the path ends; once there, until it is pushed out of the tolerance again."""
        away = motion.pose.distance(ahead.end)
        # the plan may end beside the goal, as far as the tolerance allows: what is left of it is ours
        near = max(0.03, goal.tolerance - plan.end.distance(goal.map_from_goal))
        if self.at_end:
            # stopping may carry it out again; then it comes back
            self.at_end = away < (near if abs(motion.v) < SLOW else near + BRAKING_ROOM)
        elif ahead.ends and (self.limits.spins or ahead.left < near + BRAKING_ROOM):  # else an arc leads there first
            passed = abs(self._behind(ahead, motion)) > 0.5 * pi
            self.at_end = away < 0.2 * near or (away < near and (passed or abs(motion.v) < SLOW))
        return self.at_end

    @staticmethod
    def _behind(ahead: Ahead, motion: Motion) -> float:
        """rad from the robot's heading to the path's end."""
        return wrapped(motion.pose.bearing(ahead.end) - motion.pose.yaw)

    def _turned_to_goal(self, yaw: float, goal: Goal, costmap: LocalCostmap, motion: Motion) -> Outcome:
        left = wrapped(yaw - motion.pose.yaw)
        if goal.yaw_tolerance > pi or abs(left) < 0.7 * goal.yaw_tolerance:
            standing = abs(motion.v) < 0.02 and abs(motion.w) < 0.05
            return braking(motion, self.limits, FollowState.ARRIVED if standing else FollowState.FOLLOWING, "")
        if not self.limits.spins:
            near = abs(left) <= goal.yaw_tolerance
            self.missed = not near
            return braking(motion, self.limits, *((FollowState.ARRIVED, "") if near else MISSED))
        return self._turn(self._way_round(left, costmap, motion), costmap, motion, 0.0)

    def _turned_to_way(self, scene: Scene, costmap: LocalCostmap, motion: Motion, left: float) -> Outcome | None:
        """Turning on the spot until the way lies ahead; None where there is no need to, no room, or it may not."""
        if not self.limits.spins:
            return None
        x, y = self.controller.ahead(scene, self.config.look)
        error = wrapped(atan2(y - scene.y, x - scene.x) - scene.yaw) if hypot(x - scene.x, y - scene.y) > 0.15 else 0.0
        if self.turning:
            if abs(error) < self.config.turn_until:
                self.turning = 0.0
                return None
            # on the way round the error may pass the far side, where its sign flips
            way = error + 2 * pi * self.turning if error * self.turning < 0 and abs(error) > pi / 2 else error
            if abs(way) > pi + CHANGED:
                way = self._way_round(error, costmap, motion)
        elif abs(motion.v) < 0.1 and abs(error) > self.config.turn_from:
            way = self._way_round(error, costmap, motion)
        else:
            return None
        outcome = self._turn(way, costmap, motion, left)
        self.turning = copysign(1.0, way) if outcome.state is FollowState.FOLLOWING else 0.0
        return outcome if self.turning else None

    def _way_round(self, angle: float, costmap: LocalCostmap, motion: Motion) -> float:
        """The angle, or the rest of the full turn where only that is free."""
        if abs(self._free(angle, costmap, motion)) >= abs(angle):
            return angle
        other = angle - copysign(2 * pi, angle)
        return other if abs(self._free(other, costmap, motion)) >= abs(other) else angle

    def _free(self, angle: float, costmap: LocalCostmap, motion: Motion) -> float:
        x, y = motion.pose.x - costmap.x0, motion.pose.y - costmap.y0
        return float(
            free_turn(costmap.field, costmap.occupied, costmap.resolution, x, y, motion.pose.yaw, angle, self.footprint)
        )

    def _turn(self, angle: float, costmap: LocalCostmap, motion: Motion, left: float) -> Outcome:
        look = copysign(min(abs(angle), TURN_LOOK), angle)
        if abs(self._free(look, costmap, motion)) < 0.5 * abs(look):
            return braking(motion, self.limits, FollowState.BLOCKED, reasons.BLOCKED.code, left)
        v = speed_after(motion.v, 0.0, self.limits, DT)
        w = turn_command(angle, motion.w, self.limits, DT, min(self.config.turn_rate, self.limits.w_max))
        return Outcome(v, w, FollowState.FOLLOWING, "", left)


def stopping(limits: Limits, left: float) -> Limits:
    """The limits for a robot that is to stop in so many m, but creeps on until it is there."""
    most = max(CREEP, min(DOCKING * left, sqrt(2.0 * APPROACH * limits.braking * left)))
    return limits._replace(v_max=min(limits.v_max, most))
