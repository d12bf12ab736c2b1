# SPDX-License-Identifier: Apache-2.0
"""The whole stack on the virtual clock in a world of a few lines, driven and disturbed."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from services.sim.config import SimConfig
from services.sim.service import SimService
from shared import requests, topics
from shared.config import configured
from shared.geometry import Pose2
from shared.messages import EmergencyStop, GuardStatus, Message, MotorCommand, NavState, Truth
from shared.requests import Navigate
from shared.runners.host import Sent
from shared.runners.lockstep import Lockstep
from zenav.stack.service_loader import build_service

STACK = ("sim", "base_driver", "odometry", "mapper", "planner", "local_ctrl", "guard", "navigator")
DRIVERS = {"board": "base_driver", "laser": "lidar_driver", "imu": "imu_driver"}
"""Which driver or simulated device uses which port of the robot."""
MS = 1_000_000
QUICK = ("local_ctrl.mppi.rollouts=200",)
"""A sixth of the rollouts, for drives on which the way of driving is not the subject."""
KEPT = (
    topics.BASE_STATUS,
    topics.WHEELS,
    topics.BOARD_IS,
    topics.TRUTH,
    topics.GUARD,
    topics.MOTORS,
    topics.NAV_STATUS,
    topics.CMD_VEL,
    topics.ODOM,
    topics.SCAN,
    topics.POSE,
)
OLDEST = {"odom": 250, "scan": 100 + 350, "cmd/vel": 250}
"""ms after its stamp that each input may still move the robot; a scan's stamp is its first beam's, 100 ms earlier."""
HALL = """
start: {x: 1.0, y: 2.0}
walls:
  - {points: [[0, 0], [10, 0], [10, 4], [0, 4]], closed: true}
boxes:
  - {x: 3.0, y: 0.3, size: [0.4, 0.5]}
  - {x: 6.0, y: 3.6, size: [0.6, 0.7]}
"""
"""Ten metres to drive at full speed, with two boxes to see by where one is."""


class LockstepStack:
    """All services in a world. Poses are in `map`, whose origin is the robot's start."""

    def __init__(
        self,
        folder: Path,
        world: str = HALL,
        sim: type[SimService] = SimService,
        settings: tuple[str, ...] = (),
        names: tuple[str, ...] = STACK,
        robot: str = "x80sv",
    ) -> None:
        path = folder / "world.yaml"
        path.write_text(world)
        self.file = configured(robot, [f"sim.world={path}", "sim.clutter_jitter=0", *settings])
        services = {name: build_service(name, self.file, self.file.robot) for name in names if name != "sim"}
        services |= {"sim": sim(self.file.section("sim", SimConfig), self.file.robot)}
        wires = tuple(((name, port), ("sim", port)) for port, name in DRIVERS.items() if port in services["sim"].ports)
        self.lockstep = Lockstep(services, wires=wires)
        self.newest: dict[str, Any] = {}
        self.lost: dict[str, Callable[[int], bool]] = {}  # key -> whether a message sent at this ns is lost
        self.lockstep.filters.append(self._filtered)
        self.old: list[str] = []  # motions on inputs that were too old for them
        for topic in KEPT:
            self.lockstep.watch(topic.key, partial(self._keep, topic.key))
        self.lockstep.run(2.0)

    def _keep(self, key: str, message: Message) -> None:
        self.newest[key] = message
        if key == "hardware/motors" and self.commanded:
            ages = {key: (self.now - self.newest[key].stamp) / MS for key in OLDEST if key in self.newest}
            self.old += [f"{key} {age:.0f} ms" for key, age in ages.items() if age > OLDEST[key]]

    def _filtered(self, sent: Sent, _: str) -> float | None:
        lost = self.lost.get(sent.key)
        return None if lost is not None and lost(sent.envelope.sent) else 0.0

    @property
    def now(self) -> int:
        return self.lockstep.now

    @property
    def truth(self) -> Truth:
        return self.newest["sim/truth"]

    @property
    def guard(self) -> GuardStatus:
        return self.newest["guard/status"]

    @property
    def motors(self) -> MotorCommand:
        return self.newest["hardware/motors"]

    @property
    def commanded(self) -> bool:
        """Whether the board's last command turns a wheel."""
        return bool(self.motors.left or self.motors.right)

    def go(self, x: float, y: float = 0.0) -> None:
        """Sends the robot to a place."""
        assert self.lockstep.ask(requests.NAVIGATE, Navigate(self.now, (Pose2(x, y, 0.0),), 0.0, 1, True)).accepted

    def until(self, holds: Callable[[], object], seconds: float) -> int:
        """Runs until the condition holds; returns for how many ns. Fails when it does not within `seconds`."""
        begun = self.now
        assert self.lockstep.run(seconds, lambda: bool(holds())), (self.guard, self.newest.get("nav/status"))
        return self.now - begun

    def drives(self, at_least: float = 0.75) -> None:
        """Waits until the robot drives at this speed."""
        self.until(lambda: self.truth.v >= at_least, 8.0)

    def stands_for(self, seconds: float) -> None:
        """Nothing is commanded, and nothing moves, for this long."""
        place = self.truth.world_from_base
        moved = self.lockstep.run(seconds, lambda: self.commanded)
        assert not moved, (self.guard, self.motors)
        assert self.truth.world_from_base.distance(place) < 0.005

    def reached(self) -> bool:
        return self._nav is NavState.REACHED

    def ended(self) -> bool:
        """Whether the task is over, well or not."""
        return self._nav not in (NavState.NAVIGATING, NavState.RECOVERING, NavState.IDLE)

    @property
    def _nav(self) -> NavState:
        return self.newest["nav/status"].state

    def start(self, name: str) -> None:
        """Starts a service again after it was killed."""
        self.lockstep.start(name, build_service(name, self.file, self.file.robot))

    def stop(self, pressed: bool) -> None:
        self.lockstep.publish(topics.ESTOP(EmergencyStop(self.now, pressed, "test")))
