# SPDX-License-Identifier: Apache-2.0
"""The goals of the actions: one is active, and it is the navigator's task. Times are ns on the stack's clock.

Source: design.ros2.org/articles/actions.html; rcl_action, goal_state_machine.c. As in Nav2, a new goal ends the former.
"""

from enum import IntEnum
from typing import Any

import numpy as np

from services.ros2.action_goal import ENDED, ActionGoal, GoalState
from services.ros2.action_messages import amount_of, feedback, ignored_fields, result, route_of, stack_request
from services.ros2.action_topics import CANCEL_GOAL, CANCEL_TYPE, GET_RESULT, SEND_GOAL, STATUS_TYPE, Action, actions_of
from services.ros2.orders import publish_order, reply_order
from services.ros2.ros_types import UUID, RosTypes
from services.ros2.task_requests import AskStack
from shared import reasons, requests
from shared.messages import NavState, NavStatus, PoseEstimate
from shared.reasons import reason_text
from shared.requests import Cancel
from shared.ros_messages import RosMessages
from shared.service import Log, Out
from shared.topics import Publication
from shared.types import NS_PER_S

KEPT_NS = 600 * NS_PER_S
"""for which a result can be asked for: rcl_action's 10 s are too short for a slow link, Nav2 sets 900 s."""
MAX_GOALS = 32
MAX_BEHIND_NS = 2 * NS_PER_S
"""for which the navigator's task may have a lower number than the goal's: then a new navigator counts from 0."""
CANCEL_PERIOD_NS = NS_PER_S
NO_ID = bytes(16)
REPLACED = "replaced by another goal"


class CancelCode(IntEnum):
    """action_msgs/CancelGoal."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL = 2
    TERMINATED = 3


class GoalRefusedError(ValueError):
    """A goal that is none; its client has the refusal already."""


class ActionServer:
    """See the module. ask: makes orders of requests to the stack."""

    def __init__(self, types: RosTypes, make: RosMessages, ask: AskStack) -> None:
        self._types, self._make, self._ask = types, make, ask
        self._actions = {action.name: action for action in actions_of(types.distro)}
        self._goals: dict[bytes, ActionGoal] = {}
        self._active: ActionGoal | None = None
        self._status: NavStatus | None = None
        self.estimate: PoseEstimate | None = None
        """The newest pose, for the feedback."""

    def serves(self, name: str) -> bool:
        """Whether a service is one of an action."""
        return "/_action/" in name

    @property
    def state(self) -> str:
        """Words for the health; empty without a goal."""
        return f"a goal of {self._active.action.name} runs" if self._active is not None else ""

    def request(self, name: str, number: int, data: bytes, now: int) -> Out:
        """A request to one of the services. Raises ValueError where the bytes are none, without a reply."""
        action_name, _, part = name.partition("/_action/")
        action = self._actions[action_name]
        if part == SEND_GOAL:
            yield from self._send_goal(action, number, data, now)
        elif part == GET_RESULT:
            yield from self._get_result(action, number, data, now)
        elif part == CANCEL_GOAL:
            yield from self._cancel(action, number, data, now)

    def nav_status(self, status: NavStatus, now: int) -> Out:
        """The navigator's status: feedback of the active goal, or its end."""
        self._status = status
        yield from self._follow(now)

    # --- the services -----------------------------------------------------------------------------------------------

    def _send_goal(self, action: Action, number: int, data: bytes, now: int) -> Out:
        message = self._types.decode(data, f"{action.type}_SendGoal_Request")
        goal_id = bytes(message.goal_id.uuid)
        try:
            row, request = stack_request(now, action, message.goal, self._make.frames.map)
            if goal_id in self._goals:
                raise ValueError("a goal with this id exists")
        except ValueError as error:
            yield self._goal_reply(action, number, False, now)
            raise GoalRefusedError(str(error)) from None
        if ignored := ignored_fields(action, message.goal):
            yield Log("WARNING", f"ROS 2: {action.name}: {ignored}")
        poses, first = route_of(action, message.goal)
        goal = ActionGoal(goal_id, action, now, amount=amount_of(request), poses=poses, first=first, waypoint=first)
        yield self._ask(row, request, lambda outcome: self._on_accepted(goal, number, outcome))

    def _on_accepted(self, goal: ActionGoal, number: int, outcome: dict[str, Any]) -> Out:
        now = outcome["now"]
        yield self._goal_reply(goal.action, number, outcome["accepted"], now)
        if not outcome["accepted"]:
            return
        goal.state, goal.task_id, goal.accepted = GoalState.EXECUTING, outcome["data"]["task_id"], now
        active = self._active
        if active is not None and goal.is_before(active):
            self._goals[goal.id] = goal
            yield from self._end(goal, GoalState.ABORTED, REPLACED, now)
            return
        if active is not None:
            yield from self._end(active, GoalState.ABORTED, REPLACED, now)
        self._forget(now)
        self._goals[goal.id] = self._active = goal
        yield self._status_order(goal.action, now)
        yield from self._follow(now)

    def _get_result(self, action: Action, number: int, data: bytes, now: int) -> Out:
        message = self._types.decode(data, f"{action.type}_GetResult_Request")
        goal = self._goals.get(bytes(message.goal_id.uuid))
        if goal is None or goal.action != action:
            yield self._result_reply(ActionGoal(NO_ID, action, now, GoalState.UNKNOWN), number, now)
        elif goal.state in ENDED:
            yield self._result_reply(goal, number, now)
        else:
            goal.waiting.append(number)

    def _cancel(self, action: Action, number: int, data: bytes, now: int) -> Out:
        info = self._types.decode(data, f"{CANCEL_TYPE}_Request").goal_info
        goal_id, before = bytes(info.goal_id.uuid), info.stamp.sec * NS_PER_S + info.stamp.nanosec
        own = [goal for goal in self._goals.values() if goal.action == action]
        running = [goal for goal in own if goal.state is GoalState.EXECUTING]
        if goal_id == NO_ID:
            chosen = [goal for goal in running if not before or goal.begun <= before]
            code = CancelCode.NONE if chosen or not before else CancelCode.REJECTED
        else:
            chosen = [goal for goal in running if goal.id == goal_id]
            known = any(goal.id == goal_id for goal in own)
            code = CancelCode.NONE if chosen else CancelCode.TERMINATED if known else CancelCode.UNKNOWN_GOAL
        for goal in chosen:
            goal.state, goal.canceled = GoalState.CANCELING, now
        make = self._make
        infos = [self._info(goal) for goal in chosen]
        response = make.new(f"{CANCEL_TYPE}_Response", return_code=int(code), goals_canceling=infos)
        yield reply_order(now, number, self._types.encode(response))
        if chosen:
            yield self._status_order(action, now)
            yield self._cancel_order(now)

    # --- the active goal --------------------------------------------------------------------------------------------

    def _follow(self, now: int) -> Out:
        goal, status = self._active, self._status
        if goal is None or goal.task_id is None or status is None:
            return
        if status.task_id < goal.task_id:
            goal.behind_since = now if goal.behind_since is None else goal.behind_since
            if now - goal.behind_since >= MAX_BEHIND_NS:
                goal.fail(reasons.INTERRUPTED.code)
                yield from self._end(goal, GoalState.ABORTED, reasons.INTERRUPTED.text, now)
            return
        goal.behind_since = None
        if status.task_id > goal.task_id:
            yield from self._end(goal, GoalState.ABORTED, "replaced by another task", now)
        elif status.state is NavState.REACHED:
            yield from self._end(goal, GoalState.SUCCEEDED, "", now)
        elif status.state is NavState.CANCELED and goal.state is GoalState.CANCELING:
            yield from self._end(goal, GoalState.CANCELED, "", now)
        elif status.state in (NavState.FAILED, NavState.CANCELED, NavState.IDLE):
            words = [str(status.state), reason_text(status.reason), status.detail]
            if status.state is NavState.FAILED:
                goal.fail(status.reason)
            yield from self._end(goal, GoalState.ABORTED, ": ".join(word for word in words if word), now)
        else:
            goal.follow(status)
            part = feedback(self._make, self._types.distro, goal, status, self.estimate, now)
            message = self._make.new(f"{goal.action.type}_FeedbackMessage", goal_id=self._uuid(goal.id), feedback=part)
            yield publish_order(now, goal.action.part("feedback"), self._types.encode(message))
            if goal.state is GoalState.CANCELING and now - goal.canceled >= CANCEL_PERIOD_NS:
                goal.canceled = now
                yield self._cancel_order(now)

    def _cancel_order(self, now: int) -> Publication:
        """Asks the navigator to cancel its task. Where no answer comes it is asked again while the task goes on."""
        return self._ask(requests.CANCEL, Cancel(now), lambda outcome: ())

    def _end(self, goal: ActionGoal, state: GoalState, error: str, now: int) -> Out:
        goal.state, goal.error, goal.ended = state, error, now
        if goal is self._active:
            self._active = None
        waiting, goal.waiting = goal.waiting, []
        for number in waiting:
            yield self._result_reply(goal, number, now)
        yield self._status_order(goal.action, now)

    def _forget(self, now: int) -> None:
        """Removes old results."""
        ended = [goal for goal in self._goals.values() if goal.state in ENDED]
        n_too_many = len(self._goals) - MAX_GOALS + 1
        for i, goal in enumerate(ended):
            if i < n_too_many or now - goal.ended > KEPT_NS:
                del self._goals[goal.id]

    # --- messages ---------------------------------------------------------------------------------------------------

    def _goal_reply(self, action: Action, number: int, accepted: bool, now: int) -> Publication:
        type_ = f"{action.type}_SendGoal_Response"
        response = self._make.new(type_, accepted=accepted, stamp=self._make.time(now))
        return reply_order(now, number, self._types.encode(response))

    def _result_reply(self, goal: ActionGoal, number: int, now: int) -> Publication:
        part = result(self._make, self._types.distro, goal)
        type_ = f"{goal.action.type}_GetResult_Response"
        return reply_order(now, number, self._types.encode(self._make.new(type_, status=int(goal.state), result=part)))

    def _status_order(self, action: Action, now: int) -> Publication:
        rows = [
            self._make.new("action_msgs/msg/GoalStatus", goal_info=self._info(goal), status=int(goal.state))
            for goal in self._goals.values()
            if goal.action == action
        ]
        message = self._make.new(STATUS_TYPE, status_list=rows)
        return publish_order(now, action.part("status"), self._types.encode(message))

    def _info(self, goal: ActionGoal) -> Any:
        return self._make.new(
            "action_msgs/msg/GoalInfo", goal_id=self._uuid(goal.id), stamp=self._make.time(goal.begun)
        )

    def _uuid(self, goal_id: bytes) -> Any:
        return self._make.new(UUID, uuid=np.frombuffer(goal_id, np.uint8))
