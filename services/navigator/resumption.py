# SPDX-License-Identifier: Apache-2.0
"""Resumption after a restart: the task of the navigator before this one, and whether it continues."""

from dataclasses import dataclass

from services.navigator.exploration import Exploration
from services.navigator.navigation import Navigation
from services.navigator.route import Route
from services.navigator.shared_exploration import SharedExploration
from shared import reasons, topics
from shared.messages import ExplorationShare, GuardState, NavState, NavTask, TaskKind
from shared.reasons import Reason
from shared.service import Out
from shared.stamps import FUTURE, fresh

PUBLISH_PERIOD_S = 0.5  # s
_MAX_WAIT_S = 2.0  # after the start, for guard, map and pose
_MAX_GUARD_AGE_S = 1.0  # of a status: the guard publishes ten times a second

_Key = tuple[object, ...]


@dataclass(frozen=True, slots=True)
class ResumeRefusal:
    """Why the task does not continue. waits: it still may, until the time is over."""

    reason: Reason
    detail: str
    state: NavState = NavState.FAILED
    waits: bool = False


class Resumption:
    """Publishes the present task periodically, and resumes the one from before a restart."""

    def __init__(self, navigation: Navigation) -> None:
        self.navigation = navigation
        self.before: NavTask | None = None  # until its resumption is decided
        self.share: ExplorationShare | None = None  # the last one before the restart
        self._began = 0  # ns, when it was remembered
        self._published: NavTask | None = None

    @property
    def pending(self) -> bool:
        """Whether the goal from before the restart stays until its resumption is decided."""
        return self.before is not None and not self._late(self.before)

    def remember(self, task: NavTask, now: int) -> None:
        """Takes the last task of a navigator before this one. Without effect where a task was given already."""
        navigation = self.navigation
        if navigation.task is not None or navigation.task_id >= task.task_id:
            return
        navigation.task_id, self._published = task.task_id, task
        if task.kind is not TaskKind.NONE:
            self.before, self._began = task, now
            working = NavState.EXPLORING if task.kind is TaskKind.EXPLORE else NavState.NAVIGATING
            navigation.state = NavState.PAUSED if task.paused else working
            navigation.reason = reasons.STARTING

    def forget(self) -> None:
        """Drops the former task: another one was given, or it was canceled."""
        self.before = None

    def take_up(self, now: int) -> Out:
        """Resumes the former task as soon as all inputs are known, or ends it with the reason."""
        before, navigation = self.before, self.navigation
        if before is None:
            return
        refusal = self._refusal(before, now)
        if refusal is not None and refusal.waits:
            return
        self.before = None
        if refusal is not None:
            yield from navigation.end(now, refusal.state, refusal.reason, refusal.detail)
            return
        dwell = None
        if before.dwelling:
            away = 0.0 if before.paused else (now - before.stamp) * 1e-9
            dwell = max(before.dwell - away, 0.0)
        yield from navigation.resume(_task_of(before, navigation, self.share), dwell, before.paused, now)
        navigation.age = before.age

    def tell(self, now: int) -> Out:
        """Publishes the task where it changed or the period is over."""
        if self.before is not None:
            return
        message = _message(self.navigation, now)
        published = self._published
        if _key(message) == (_key(published) if published else _NOTHING):
            alive = published is not None and 0 <= now - published.stamp < round(PUBLISH_PERIOD_S * 1e9)
            if alive or message.kind is TaskKind.NONE:
                return
        self._published = message
        yield topics.TASK(message)

    def _refusal(self, before: NavTask, now: int) -> ResumeRefusal | None:
        """Why the task does not continue, or not yet."""
        navigation = self.navigation
        guard, grid = navigation.statuses.recent_guard(now), navigation.grid
        guard = guard if guard is not None and fresh(guard.stamp, now, _MAX_GUARD_AGE_S) else None
        if (stopped := navigation.statuses.stop_reason(now)) and guard is not None:
            state = NavState.CANCELED if guard.state is GuardState.STOPPED else NavState.FAILED
            return ResumeRefusal(stopped, f"{stopped.text} since the navigator was restarted: {stopped.hint}", state)
        disarmed = guard is not None and guard.reason == reasons.ESTOP_RELEASED.code
        if guard is not None and (disarmed or guard.stopped > before.stamp - FUTURE):
            released = reasons.ESTOP_RELEASED
            detail = f"while the navigator was restarted; {released.hint}"
            return ResumeRefusal(released, f"{released.text} {detail}", NavState.CANCELED)
        if before.map_id and grid.map_id not in (0, before.map_id):
            return ResumeRefusal(reasons.OTHER_MAP, "", NavState.CANCELED)
        away = (self._began - before.stamp) * 1e-9
        if away < -FUTURE * 1e-9 or now < self._began:
            return ResumeRefusal(reasons.INTERRUPTED, "the clock was set back meanwhile; give the task again")
        late, waited = self._late(before), now - self._began > round(_MAX_WAIT_S * 1e9)
        lacking = {
            "the guard": guard is None,  # it knows of a STOP meanwhile
            "the map": bool(before.map_id) and grid.empty and not late,
            "the pose": navigation.pose_tracker.map_from_base is None and not late,
        }
        missing = [name for name, lacks in lacking.items() if lacks]
        if missing and not waited:
            return ResumeRefusal(reasons.STARTING, "", waits=True)
        if late:
            max_away = navigation.config.resume_within
            detail = f"it was away for {away:.1f} s, and a task goes on after at most {max_away:g} s: give it again"
            return ResumeRefusal(reasons.INTERRUPTED, detail)
        if missing:
            return ResumeRefusal(
                reasons.INTERRUPTED, f"{' and '.join(missing)} missing since then: give the task again"
            )
        return None

    def _late(self, before: NavTask) -> bool:
        return self._began - before.stamp > round(self.navigation.config.resume_within * 1e9)


def _message(navigation: Navigation, now: int) -> NavTask:
    task = navigation.task
    route = task if isinstance(task, Route) else None
    explores = isinstance(task, Exploration)
    kind = TaskKind.ROUTE if route else TaskKind.EXPLORE if explores else TaskKind.NONE  # a motion does not continue
    dwelling = route is not None and navigation.attempt is None
    return NavTask(
        stamp=now,
        task_id=navigation.task_id,
        kind=kind,
        age=min(navigation.age, 1e7) if route or explores else 0.0,
        map_id=navigation.grid.map_id if route or explores else 0,
        paused=navigation.paused,
        poses=route.poses if route else (),
        dwells=route.dwells if route else (),
        loops=route.loops if route else 0,
        any_heading=route.any_heading if route else False,
        tolerance=route.tolerance if route else 0.0,
        yaw_tolerance=route.yaw_tolerance if route else 0.0,
        waypoint=route.index if route else 0,
        round=route.round if route else 0,
        dwelling=dwelling,
        dwell=max(navigation.dwell, 0.0) if dwelling else 0.0,
        pass_through=route.pass_through if route else False,
    )


def _key(task: NavTask) -> _Key:
    """The fields by which one task, or one part of it, differs from another."""
    return task.task_id, task.kind, task.map_id, task.paused, task.waypoint, task.round, task.dwelling


_NOTHING: _Key = (0, TaskKind.NONE, 0, False, 0, 0, False)


def _task_of(before: NavTask, navigation: Navigation, share: ExplorationShare | None) -> Route | Exploration:
    """The task.  share: the last one before the restart, perhaps of another task."""
    if before.kind is TaskKind.EXPLORE:
        config, sharing = navigation.config.exploration, None
        if share is not None and share.task_id == before.task_id:
            sharing = SharedExploration(config.sharing, share.robot, share.others, share.common_from_map)
        return Exploration(config, sharing)
    tolerance = before.tolerance or navigation.config.tolerance
    yaw_tolerance = before.yaw_tolerance or navigation.config.yaw_tolerance
    return Route(
        poses=before.poses,
        dwells=before.dwells,
        loops=before.loops,
        any_heading=before.any_heading,
        tolerance=tolerance,
        yaw_tolerance=yaw_tolerance,
        pass_through=before.pass_through,
        index=before.waypoint,
        round=before.round,
    )
