# SPDX-License-Identifier: Apache-2.0
"""Several robots in one world on the virtual clock, each with a stack of its own. Their messages to each other are
carried from stack to stack, unless a fault drops them.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

from shared import topics
from shared.config import configured
from shared.geometry import Pose2
from shared.messages import ExplorationShare, NavStatus, PoseEstimate, RobotIntent, Truth
from shared.recording import CONFIG, Writer, about, sink
from shared.requests import Request
from shared.robot_files import own_name_and_kind
from shared.runners.lockstep import START, Lockstep
from shared.types import NS_PER_S
from zenav.scenario.lockstep_run import lockstep_services
from zenav.scenario.scenario import Scenario, load_scenario
from zenav.scenario.shared_world import SharedWorld, start_poses
from zenav.stack.hardware import simulated_world, wires
from zenav.stack.service_loader import build_service

STEP_S = 0.02  # s between two looks at each other: a tick of the simulator
BODY = "sim", "base_driver"  # what goes on when a robot's computer dies: its wheels are stopped by its base

Hears = Callable[[str, str], bool]
"""(speaker, listener) -> whether the message arrives."""


class GroupMember:
    """One robot of a group: its scenario, its lockstep, and the newest truth, pose and status."""

    def __init__(self, name: str, scenario: Scenario, record: Path | None) -> None:
        self.name, self.scenario = name, scenario
        self.world_name, self.start = scenario.world.name, scenario.world.start
        self.truth: Truth | None = None
        self.nav: NavStatus | None = None
        self.pose: PoseEstimate | None = None
        self.shares: list[ExplorationShare] = []  # that the others have not heard yet
        self._writer: Writer | None = None
        joined = wires(scenario.hardware, scenario.file)
        if record is None:
            self.lockstep = Lockstep(lockstep_services(scenario), wires=joined)
        else:
            self._writer = Writer(record, about(name), {CONFIG: scenario.file.text.encode()})
            self.lockstep = Lockstep(lockstep_services(scenario), sink(self._writer), joined)
        self.lockstep.watch(topics.TRUTH.key, self._keep_truth)
        self.lockstep.watch(topics.NAV_STATUS.key, self._keep_status)
        self.lockstep.watch(topics.SHARE.key, self.shares.append)
        self.lockstep.watch(topics.POSE.key, self._keep_pose)

    def now(self) -> int:
        """ns of virtual time."""
        return self.lockstep.now

    def ask(self, request: Request[Any, Any], message: Any) -> Any:
        """The reply to a request."""
        return self.lockstep.ask(request, message)

    def restart(self, name: str) -> None:
        """Ends a service and starts it again, without what it knew."""
        self.lockstep.kill(name)
        self.lockstep.start(name, build_service(name, self.scenario.file, self.scenario.file.robot))

    def die(self) -> None:
        """All its services end, but for its body."""
        for name in self.scenario.names:
            if name not in BODY and self.lockstep.runs(name):
                self.lockstep.kill(name)

    def close(self) -> None:
        """Ends its recording."""
        self.lockstep.flush()
        if self._writer is not None:
            self._writer.close()

    def _keep_truth(self, truth: Truth) -> None:
        self.truth = truth

    def _keep_pose(self, pose: PoseEstimate) -> None:
        self.pose = pose

    def _keep_status(self, status: NavStatus) -> None:
        self.nav = status


class RobotGroup:
    """Runs the robots step by step; between two steps each simulator is shown the others."""

    def __init__(
        self,
        robot: str,
        world: str,
        names: Sequence[str],
        seed: int = 0,
        settings: Sequence[str] = (),
        starts: Sequence[Pose2] = (),
        folder: Path | None = None,
    ) -> None:
        """seed: of the world, and of every robot's noise.

        starts: where the robots begin, in the world; without them around the world's own start.
        folder: where NAME.mcap of each robot is written, if it is.
        """
        plain = configured(robot, [f"sim.world={world}", f"sim.seed={seed}", *settings])
        self.world = simulated_world(plain)
        starts = list(starts) or start_poses(self.world, len(names), plain.robot.circumscribed_radius)
        self._shared = SharedWorld(dict.fromkeys(names, plain.robot))
        self.members: list[GroupMember] = []
        self.hears: Hears = lambda speaker, listener: True
        kind = own_name_and_kind(robot)[1]
        for name, start in zip(names, starts, strict=True):
            own = [f"sim.start={{x: {start.x!r}, y: {start.y!r}, yaw: {start.yaw!r}}}"]
            own.append(f"sim.other_discs={self._shared.n_discs(name)}")
            scenario = load_scenario(f"{name}@{kind}", world, seed, [*settings, *own], meets_robots=True)
            member = GroupMember(name, scenario, folder / f"{name}.mcap" if folder else None)
            member.lockstep.watch(topics.INTENT.key, partial(self._carry, name))
            self.members.append(member)

    @property
    def now(self) -> float:
        """s since the start."""
        return (self.members[0].lockstep.now - START) / NS_PER_S

    def run(self, seconds: float) -> None:
        """Lets virtual time pass."""
        end = self.now + seconds
        while self.now < end - STEP_S / 2:
            for member in self.members:
                member.lockstep.run(STEP_S)
                if member.truth is not None:
                    self._shared.move(member.name, member.truth)
            self._exchange()
            for member in self.members:
                member.lockstep.publish(topics.OTHERS(self._shared.others(member.name, member.lockstep.now)))

    def _carry(self, speaker: str, intent: RobotIntent) -> None:
        """Takes a robot's intent to all others."""
        for member in self.members:
            if member.name != speaker and self.hears(speaker, member.name):
                member.lockstep.hear(topics.HEARD(intent))

    def _exchange(self) -> None:
        """Passes on what each robot has said to the others since the last step."""
        for sender in self.members:
            for share in sender.shares:
                for member in self.members:
                    if member is not sender:
                        member.lockstep.publish(topics.OTHERS_SHARE(share))
            sender.shares.clear()

    def __enter__(self) -> "RobotGroup":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for member in self.members:
            member.close()
