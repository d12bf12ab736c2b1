# SPDX-License-Identifier: Apache-2.0
"""The plan of the monitor as a message: what is left of it."""

import numpy as np

from services.planner.plan_monitor import PlanMonitor, path_length
from services.planner.planning import GlobalPlan
from shared.messages import Goal, Path


def plan_message(monitor: PlanMonitor, plan: GlobalPlan, goal: Goal, map_version: int, now: int) -> Path:
    """The plan from the robot's progress on. now: ns."""
    points, yaws = plan.points[monitor.index :], plan.yaws[monitor.index :]
    return Path(
        stamp=now,
        goal_id=goal.id,
        map_version=map_version,
        reason=plan.reason.code if plan.reason else "",
        xs=np.ascontiguousarray(points[:, 0]),
        ys=np.ascontiguousarray(points[:, 1]),
        yaws=yaws,
        length=path_length(points),
        cost=monitor.cost_left,
    )
