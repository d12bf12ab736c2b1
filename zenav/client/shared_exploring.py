# SPDX-License-Identifier: Apache-2.0
"""`zenav explore`, alone or with other robots: it passes on what the others say while the robot explores.

Each robot's own command does so. Where one ends, its robot hears the others no more: after the lease it explores alone.
"""

import threading
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from math import radians

import zenoh

from shared import requests, topics
from shared.config import UserError, load_robot
from shared.geometry import Pose2, wrapped
from shared.messages import ExplorationShare
from shared.requests import MAX_OTHERS, Explore, Reply
from shared.runners.transport import StackAddress, stack_address
from zenav.client import Client
from zenav.client.named_items import NAME
from zenav.client.navigation_client import run_task


def explore(robot: str, stack: str, others: Sequence[str], origin: tuple[float, float, float]) -> int:
    """Explores; 0 when nothing reachable is left. Raises UserError where a name of another robot is wrong.

    others: NAME, or NAME@STACK of a robot in another stack.  origin: m, m, degrees of `map` in the common frame.
    """
    stacks = other_stacks(others, load_robot(robot).robot.name, stack)
    x, y, yaw = origin
    common_from_map = Pose2(x, y, wrapped(radians(yaw)))
    with ExitStack() as sessions:

        def start(client: Client) -> Reply:
            relay = ShareRelay(client)
            for name, address in stacks.items():
                sessions.enter_context(Client(name, address)).listen(topics.SHARE, lambda share, _: relay.add(share))
            return client.ask(requests.EXPLORE, Explore(client.now(), tuple(stacks), common_from_map))

        return run_task(robot, stack, start)


def other_stacks(others: Sequence[str], own: str, stack: str) -> dict[str, StackAddress]:
    """The stacks of other robots by their names. Raises UserError."""
    stacks: dict[str, StackAddress] = {}
    for text in others:
        name, at, where = text.partition("@")
        if not NAME.fullmatch(name) or name == own or name in stacks:
            reason = "is this robot itself" if name == own else "names no other robot"
            raise UserError(f"--with {text} {reason}", "name each other robot once: --with blue, or --with blue@2")
        stacks[name] = stack_address(where if at else stack)
    if len(stacks) > MAX_OTHERS:
        raise UserError(f"{len(stacks)} other robots are too many", f"at most {MAX_OTHERS} explore with one")
    return stacks


class ShareRelay:
    """Publishes in a robot's stack what the others say in theirs. Threads of several sessions may use it."""

    def __init__(self, client: Client) -> None:
        self._client, self._lock = client, threading.Lock()

    def add(self, share: ExplorationShare) -> None:
        """Passes a message on."""
        with self._lock, suppress(zenoh.ZError):  # the task has ended, and its session is closed
            self._client.publish(topics.OTHERS_SHARE(share))
