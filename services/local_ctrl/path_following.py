# SPDX-License-Identifier: Apache-2.0
"""Path following: turning to the plan in place, driving it by a controller, stopping at its end, turning to its
heading.

Turning in place before driving is that of Nav2's RotationShimController, with its two thresholds. The arrival is
latched as in Nav2's SimpleGoalChecker (`stateful`), but a robot that leaves the tolerance drives back. The choice
of a free direction and the report of a blocked path are our own. So is the path beyond the goal for a robot with a
turning radius.
"""

from math import atan2, copysign, hypot, inf, isinf, pi, sqrt

import numpy as np
from pydantic import Field

from services.local_ctrl.controller import APPROACH_BRAKING_SHARE, Controller, ControlScene
from services.local_ctrl.cost_to_go import CostToGoConfig, cost_to_go
from services.local_ctrl.dynamic_obstacles import predicted_discs
from services.local_ctrl.footprint import Footprint, bilinear
from services.local_ctrl.local_costmap import LocalCostmap
from services.local_ctrl.local_plan import MAX_ADVANCE_M, SPACING, LocalPlan, PathAhead, cut_at_turn
from services.local_ctrl.manoeuvres import TURN_LOOKAHEAD_RAD, ControlOutcome, braking, free_angle, turn_command
from services.local_ctrl.other_robots import STOP_SHORT_M, LocalTraffic, without_robots
from services.local_ctrl.rollout import DT, Limits, Motion, speed_after
from services.local_ctrl.zones import LocalZones
from shared import reasons
from shared.config import Section
from shared.geometry import Pose2, wrapped
from shared.messages import FollowState, Goal
from shared.types import Float64s

STANDING_SPEED = 0.05  # m/s
BRAKING_MARGIN_M = 0.3  # m
MAX_ARC_ADVANCE_RADII = 2.0  # along the path within which a robot that drives arcs is searched for: less than a loop
MAX_TURN_AHEAD_RAD = 1.9  # of the path ahead, for a robot that drives arcs
EXTENSION_RADII = 1.5  # of straight path beyond the goal, for a robot that cannot turn there
CREEP_SPEED = 0.06  # m/s
DOCKING_SPEED_PER_M = 0.6  # m/s per metre to such a goal: slow enough to reach its heading
ARC_OFF_PATH_COST = 4.0  # slowness per metre beside the plan, and at most, for a robot that drives arcs
NO_POINTS: Float64s = np.empty((0, 2))
HEADING_MISSED = FollowState.FAILED, reasons.HEADING_MISSED.code
TURN_HYSTERESIS_RAD = 0.5  # over half a turn of remaining rotation: beyond it the direction is chosen again
REFUGE_M = 0.2  # from the refuge at which a robot that makes way stands
THREAT_TIME_S, THREAT_CLEARANCE_M = 2.0, 0.2  # s until something would be this near, m, if the robot stood
WINDOW_MARGIN_M = 0.25  # between the path and the window's edge: the field around its end needs room


class PathFollowingConfig(Section):
    """Following the plan."""

    turn_from: float = Field(
        1.0, ge=0.2, le=3.2, description="rad to the path at which a standing robot turns in place"
    )
    turn_until: float = Field(0.3, ge=0.05, le=3, description="rad to the path at which it drives again")
    turn_rate: float = Field(1.5, ge=0.1, le=10, description="maximum rad/s of turning in place")
    look: float = Field(0.4, ge=0.1, le=3, description="m along the path to the point that the robot turns to")
    closed_within: float = Field(
        0.25, ge=0.05, le=5, description="m to the blocked point of the path at which it is reported as blocked"
    )
    stalled_after: float = Field(
        0.5, ge=0.05, le=10, description="s without progress until the path is reported as blocked"
    )


class PathFollower:
    """Follows a plan, with the state between ticks."""

    def __init__(
        self,
        config: PathFollowingConfig,
        cost_to_go: CostToGoConfig,
        controller: Controller,
        limits: Limits,
        footprint: Footprint,
        zones: LocalZones,
    ) -> None:
        self.footprint, self.zones, self.traffic = footprint, zones, LocalTraffic()
        self.configure(config, cost_to_go, controller, limits)
        self.reset()

    def configure(
        self, config: PathFollowingConfig, cost_to_go: CostToGoConfig, controller: Controller, limits: Limits
    ) -> None:
        """Takes settings and a controller made from them. The state between ticks stays."""
        self.config, self.controller, self.limits = config, controller, limits
        # a robot with a turning radius must keep a planned arc and cannot drive its chord
        stays = {"beside_plan": ARC_OFF_PATH_COST, "max_beside_plan": ARC_OFF_PATH_COST}
        self.to_go = cost_to_go if isinf(limits.curvature) else cost_to_go.model_copy(update=stays)

    def reset(self) -> None:
        """The next tick starts from standstill."""
        self.controller.reset()
        self.turning = 0.0  # direction, 0: not turning
        self.at_end = False
        self.missed = False  # the goal's heading: the robot stands at the plan's end and needs another plan
        self.n_stalled = 0

    def follow(
        self,
        plan: LocalPlan,
        goal: Goal,
        costmap: LocalCostmap,
        motion: Motion,
        odom_from_map: Pose2,
        n_elapsed: int,
        now: int,
    ) -> ControlOutcome:
        """The command of one tick. motion: in `odom`, when the command acts. n_elapsed: steps of DT since the last
        tick. now: ns.
        """
        window = costmap.resolution * len(costmap.field) / 2 - WINDOW_MARGIN_M
        arcs = not isinf(self.limits.curvature)
        max_advance = (
            min(MAX_ADVANCE_M, max(MAX_ARC_ADVANCE_RADII / self.limits.curvature, 4.0 * DT * self.limits.v_max))
            if arcs
            else MAX_ADVANCE_M
        )
        ahead = plan.ahead(odom_from_map, motion.pose, window, max_advance)
        if np.abs(ahead.points[0] - (motion.pose.x, motion.pose.y)).max() > window:
            self.reset()  # the plan lies outside the window: it starts elsewhere
            return braking(motion, self.limits, FollowState.BLOCKED, reasons.POSE_JUMPED.code)
        left = ahead.left + hypot(ahead.points[0, 0] - motion.pose.x, ahead.points[0, 1] - motion.pose.y)
        cleared = self.traffic.cleared(ahead.points, odom_from_map)
        if self.traffic.gives_way:
            if ahead.ends and motion.pose.distance(ahead.end) < REFUGE_M:
                return braking(motion, self.limits, FollowState.BLOCKED, reasons.GIVING_WAY.code, left)
        elif self._is_at_end(ahead, goal, motion, odom_from_map, plan):
            return self._turn_to_goal(ahead.end.yaw, goal, costmap, motion)
        if not self.limits.spins and ahead.left == 0.0 and abs(self._bearing_error(ahead, motion)) > 0.5 * pi:
            self.missed = True  # it drove past
            return braking(motion, self.limits, *HEADING_MISSED)
        if cleared < STOP_SHORT_M:
            self.turning = 0.0
            return braking(motion, self.limits, FollowState.BLOCKED, reasons.RIGHT_OF_WAY.code, left)
        if cleared < ahead.left:
            ahead = ahead._replace(points=ahead.points[: max(2, int(cleared / SPACING) + 1)], ends=True)
        if arcs:
            ahead = cut_at_turn(ahead, MAX_TURN_AHEAD_RAD)
        self.controller.limits = self.zones.limits_in_zones(self.limits, ahead.points, motion, odom_from_map)
        slow = reasons.SPEED_ZONE.code if self.controller.limits.v_max < self.limits.v_max else ""
        slow = self.traffic.reason() or slow
        self.controller.limits = self.traffic.limits(self.controller.limits, cleared)
        at_goal = ahead.ends and cleared == inf
        extends_path = arcs and not self.limits.spins and at_goal and goal.yaw_tolerance <= pi
        beyond = self._extension(ahead, costmap) if extends_path else NO_POINTS
        if len(beyond):
            self.controller.limits = limits_to_stop(self.controller.limits, motion.pose.distance(ahead.end))
            ahead = ahead._replace(points=np.concatenate((ahead.points, beyond)), ends=False)
        scene, closed = self._control_scene(ahead, costmap, motion, self.traffic.places(now, odom_from_map))
        is_threatened = self._is_threatened(scene)
        if is_threatened:
            self.turning = 0.0
        elif not closed and (outcome := self._turn_to_path(scene, costmap, motion, left)) is not None:
            return outcome
        solution = self.controller.solve(scene, self.footprint, n_elapsed)
        stalls = closed or (solution.gain < 0.1 and abs(solution.velocities[0, 0]) < STANDING_SPEED)
        self.n_stalled = self.n_stalled + 1 if stalls and not is_threatened else 0
        if solution.collides or self.n_stalled * DT >= self.config.stalled_after:
            return braking(motion, self.limits, FollowState.BLOCKED, reasons.BLOCKED.code, left)
        v, w = solution.velocities[0]
        return ControlOutcome(
            float(v), float(w), FollowState.FOLLOWING, slow, left
        )  # slow: no stop, but the status gives the reason

    def _extension(self, ahead: PathAhead, costmap: LocalCostmap) -> Float64s:
        """(n, 2) m in `odom`: straight on from the path's end while the robot fits.

        A robot that steers for such a point passes the end with its heading; one that steers for the end itself does
        not.
        """
        along = SPACING * np.arange(1, int(EXTENSION_RADII / self.limits.curvature / SPACING) + 1)
        points = ahead.end @ np.column_stack((along, np.zeros(len(along))))
        cells = (points - (costmap.x0, costmap.y0)) / costmap.resolution
        fits = [bilinear(costmap.field, x, y) > self.footprint.circumscribed for x, y in cells.tolist()]
        return points[: fits.index(False) if False in fits else len(fits)]

    def _control_scene(
        self, ahead: PathAhead, costmap: LocalCostmap, motion: Motion, robots: Float64s
    ) -> tuple[ControlScene, bool]:
        """The scene for the controller, and whether the robot stands where the path is blocked.

        robots: (t, k, 3) m in `odom`, see ControlScene.
        """
        points = ahead.points - (costmap.x0, costmap.y0)
        x, y = motion.pose.x - costmap.x0, motion.pose.y - costmap.y0
        to_go = cost_to_go(
            costmap.field,
            costmap.unknown,
            costmap.resolution,
            points,
            (x, y),
            self.footprint.inscribed,
            self.to_go,
        )
        scene = ControlScene(
            field=costmap.field,
            occupied=costmap.occupied,
            resolution=costmap.resolution,
            to_go=to_go.field,
            end_x=float(points[to_go.i_end, 0]),
            end_y=float(points[to_go.i_end, 1]),
            ends=ahead.ends or to_go.closed,
            x=x,
            y=y,
            yaw=motion.pose.yaw,
            v=motion.v,
            w=motion.w,
            path=points[: to_go.i_end + 1],
            dynamic_obstacles=without_robots(costmap.moving_discs, robots)
            - (costmap.x0, costmap.y0, 0.0, 0.0, 0.0, 0.0),
            robots=robots - (costmap.x0, costmap.y0, 0.0),
        )
        return scene, to_go.closed and hypot(scene.end_x - x, scene.end_y - y) < self.config.closed_within

    def _is_threatened(self, scene: ControlScene) -> bool:
        """Whether a dynamic obstacle would hit the standing robot: then it must not turn in place or wait."""
        ways = predicted_discs(scene.dynamic_obstacles, round(THREAT_TIME_S / DT))
        gaps = np.hypot(ways[:, :, 0] - scene.x, ways[:, :, 1] - scene.y) - ways[:, :, 2]
        return bool((gaps < self.footprint.circumscribed + THREAT_CLEARANCE_M).any())

    def _is_at_end(self, ahead: PathAhead, goal: Goal, motion: Motion, odom_from_map: Pose2, plan: LocalPlan) -> bool:
        """Whether the robot is at the path's end; once there, until it is pushed out of the tolerance."""
        away = motion.pose.distance(ahead.end)
        # the plan may end beside the goal, which uses a part of the tolerance
        near = max(0.03, goal.tolerance - plan.end.distance(goal.map_from_goal))
        if self.at_end:
            # stopping may carry it out again; then it comes back
            self.at_end = away < (near if abs(motion.v) < STANDING_SPEED else near + BRAKING_MARGIN_M)
        elif ahead.ends and (
            self.limits.spins or ahead.left < near + BRAKING_MARGIN_M
        ):  # otherwise an arc leads there first
            passed = abs(self._bearing_error(ahead, motion)) > 0.5 * pi
            self.at_end = away < 0.2 * near or (away < near and (passed or abs(motion.v) < STANDING_SPEED))
        return self.at_end

    @staticmethod
    def _bearing_error(ahead: PathAhead, motion: Motion) -> float:
        """rad from the robot's heading to the path's end."""
        return wrapped(motion.pose.bearing(ahead.end) - motion.pose.yaw)

    def _turn_to_goal(self, yaw: float, goal: Goal, costmap: LocalCostmap, motion: Motion) -> ControlOutcome:
        left = wrapped(yaw - motion.pose.yaw)
        if goal.yaw_tolerance > pi or abs(left) < 0.7 * goal.yaw_tolerance:
            standing = abs(motion.v) < 0.02 and abs(motion.w) < 0.05
            return braking(motion, self.limits, FollowState.ARRIVED if standing else FollowState.FOLLOWING, "")
        if not self.limits.spins:
            near = abs(left) <= goal.yaw_tolerance
            self.missed = not near
            return braking(motion, self.limits, *((FollowState.ARRIVED, "") if near else HEADING_MISSED))
        return self._turn(self._turn_direction(left, costmap, motion), costmap, motion, 0.0)

    def _turn_to_path(
        self, scene: ControlScene, costmap: LocalCostmap, motion: Motion, left: float
    ) -> ControlOutcome | None:
        """The command of turning in place to the path; None where that is not needed, not free or not allowed."""
        if not self.limits.spins:
            return None
        x, y = self.controller.ahead(scene, self.config.look)
        error = wrapped(atan2(y - scene.y, x - scene.x) - scene.yaw) if hypot(x - scene.x, y - scene.y) > 0.15 else 0.0
        if self.turning:
            if abs(error) < self.config.turn_until:
                self.turning = 0.0
                return None
            # during a long turn the error may pass pi, where its sign changes
            way = error + 2 * pi * self.turning if error * self.turning < 0 and abs(error) > pi / 2 else error
            if abs(way) > pi + TURN_HYSTERESIS_RAD:
                way = self._turn_direction(error, costmap, motion)
        elif abs(motion.v) < 0.1 and abs(error) > self.config.turn_from:
            way = self._turn_direction(error, costmap, motion)
        else:
            return None
        outcome = self._turn(way, costmap, motion, left)
        self.turning = copysign(1.0, way) if outcome.state is FollowState.FOLLOWING else 0.0
        return outcome if self.turning else None

    def _turn_direction(self, angle: float, costmap: LocalCostmap, motion: Motion) -> float:
        """The angle, or its complement to the full turn where only that is free."""
        if abs(self._free_angle(angle, costmap, motion)) >= abs(angle):
            return angle
        other = angle - copysign(2 * pi, angle)
        return other if abs(self._free_angle(other, costmap, motion)) >= abs(other) else angle

    def _free_angle(self, angle: float, costmap: LocalCostmap, motion: Motion) -> float:
        x, y = motion.pose.x - costmap.x0, motion.pose.y - costmap.y0
        return float(
            free_angle(
                costmap.field, costmap.occupied, costmap.resolution, x, y, motion.pose.yaw, angle, self.footprint
            )
        )

    def _turn(self, angle: float, costmap: LocalCostmap, motion: Motion, left: float) -> ControlOutcome:
        look = copysign(min(abs(angle), TURN_LOOKAHEAD_RAD), angle)
        if abs(self._free_angle(look, costmap, motion)) < 0.5 * abs(look):
            return braking(motion, self.limits, FollowState.BLOCKED, reasons.BLOCKED.code, left)
        v = speed_after(motion.v, 0.0, self.limits, DT)
        w = turn_command(angle, motion.w, self.limits, DT, min(self.config.turn_rate, self.limits.w_max))
        return ControlOutcome(v, w, FollowState.FOLLOWING, "", left)


def limits_to_stop(limits: Limits, left: float) -> Limits:
    """The limits of a robot that has to stop in `left` m, with a creep speed until it is there."""
    most = max(CREEP_SPEED, min(DOCKING_SPEED_PER_M * left, sqrt(2.0 * APPROACH_BRAKING_SHARE * limits.braking * left)))
    return limits._replace(v_max=min(limits.v_max, most))
