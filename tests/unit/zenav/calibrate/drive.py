# SPDX-License-Identifier: Apache-2.0
"""A simulated robot that is not what its file says, driven by a calibration's manoeuvres on the virtual clock."""

from collections.abc import Generator
from typing import Any

from services.sim.config import SimConfig
from services.sim.service import SimService
from shared import topics
from shared.config import RobotFile, configured
from shared.messages import EmergencyStop, Message, Velocity
from shared.runners.lockstep import Lockstep
from zenav.calibrate.log import TOPICS, calibration_log
from zenav.calibrate.manoeuvre import HZ, StackState, VelocityStep
from zenav.stack.service_loader import build_service

SERVICES = ("base_driver", "odometry", "guard")


class CalibrationBench:
    """The stack without navigation. truth: of the laser's mount; motor_direction: of the motors; the file may err."""

    def __init__(
        self,
        *settings: str,
        world: str = "empty",
        truth: dict[str, float] | None = None,
        services: tuple[str, ...] = SERVICES,
        robot: str = "x80sv",
        record: Any = None,
        motor_direction: int = 1,
    ) -> None:
        open_air = ["guard.view.min_share=0", "guard.view.min_ahead=0"] if world == "empty" else []
        self.file: RobotFile = configured(robot, [f"sim.world={world}", "sim.clutter_jitter=0", *open_air, *settings])
        self.robot = self.file.robot
        mount = self.robot.laser.mount.model_copy(update=truth or {})
        laser = self.robot.laser.model_copy(update={"mount": mount})
        drive = self.robot.drive.model_copy(update={"motor_direction": motor_direction})
        sim = SimService(
            self.file.section("sim", SimConfig), self.robot.model_copy(update={"laser": laser, "drive": drive})
        )
        built = {name: build_service(name, self.file, self.robot) for name in services}
        self.lockstep = Lockstep({"sim": sim, **built}, record=record)
        self.log = calibration_log(self.robot)
        self.newest: dict[str, Message] = {}
        self.pressed = False
        for topic in TOPICS:
            self.lockstep.watch(topic.key, self.log.add)
        for topic in (topics.ODOM, topics.POSE, topics.GUARD, topics.TRUTH):
            self.lockstep.watch(topic.key, lambda m, key=topic.key: self.newest.__setitem__(key, m))
        self.lockstep.run(1.0)

    @property
    def seen(self) -> StackState:
        return StackState(self.lockstep.now, *(self.newest.get(key) for key in ("odom", "pose", "guard/status")))  # type: ignore[arg-type]

    def perform(self, manoeuvre: Generator[VelocityStep, StackState, Any], seconds: float = 600.0) -> Any:
        """Drives a manoeuvre to its end, and returns what it returns."""
        end = self.lockstep.now + seconds * 1e9
        ask = next(manoeuvre)
        while self.lockstep.now < end:
            if ask.stop != self.pressed:
                self.pressed = ask.stop
                self.lockstep.publish(topics.ESTOP(EmergencyStop(self.lockstep.now, ask.stop, "calibrate")))
            self.lockstep.publish(topics.TELEOP(Velocity(self.lockstep.now, ask.v, ask.w, "")))
            self.lockstep.run(1 / HZ)
            try:
                ask = manoeuvre.send(self.seen)
            except StopIteration as done:
                return done.value
        raise AssertionError("the manoeuvre does not end")
