# SPDX-License-Identifier: Apache-2.0
"""The preloaded parent dies while the robot drives: nothing else does, and what dies later comes back."""

import os
import signal

from shared import topics
from tests.stack.processes import ALL, running
from tests.stack.test_stack import stands
from zenav.stack.preloaded import Adopted


def test_the_robot_drives_on_when_the_preloaded_parent_dies_and_stands_when_a_service_does_too(tmp_path):
    with running(tmp_path, world="corridor") as stack:
        assert all(isinstance(child.process, Adopted) for child in stack.launcher.children.values())
        pids = {name: stack.pid(name) for name in ALL}
        pose = stack.client.latest(topics.POSE).map_from_base
        task = stack.go(type(pose)(pose.x + 4.0, pose.y, pose.yaw))
        stack.until(lambda: not stands(stack))
        os.kill(stack.launcher.preloaded.pid, signal.SIGKILL)
        driven = stack.client.latest(topics.TRUTH).distance
        stack.until(lambda: stack.client.latest(topics.TRUTH).distance - driven > 0.5)
        assert {name: stack.pid(name) for name in ALL} == pids
        os.kill(pids["guard"], signal.SIGKILL)
        stack.until(lambda: stands(stack))
        stack.until(lambda: stack.healths["guard"].pid not in (pids["guard"], 0))
        stack.until(stack.reached(task), 60)
        assert stack.client.latest(topics.TRUTH).n_contacts == 0
        assert {name: child.n_restarts for name, child in stack.launcher.children.items() if child.n_restarts} == {
            "guard": 1
        }
