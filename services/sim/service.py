# SPDX-License-Identifier: Apache-2.0
"""The hardware's stand-in: takes `hardware/motors`, gives `hardware/board`, `scan`, the truth and the clock."""

from math import ceil, pi
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.sim import breaking
from services.sim import dynamics as dyn
from services.sim import people as crowd
from services.sim.contact import grown, placed, touches_world
from services.sim.drive import (
    Battery,
    DriveTruth,
    battery_voltage,
    encoder_counts,
    motor_currents,
    true_wheels,
    wheel_targets,
)
from services.sim.hardware.emulation import Emulation, EmulationConfig
from services.sim.message_faults import MessageFaults
from services.sim.sensors import LaserNoise, RangeNoise, cones, measured, sweep
from services.sim.store import load
from services.sim.world import World
from shared import requests, topics
from shared.config import Robot, Section, UserError
from shared.geometry import Pose2, wrapped
from shared.messages import BoardReport, Clock, LaserScan, MotorCommand, SerialData, Truth
from shared.ports import PortConfig
from shared.requests import Break, Reply
from shared.service import Answer, Out, Service, answer, every, on

CATCH_UP_STEPS = 100  # 0.5 s: after a longer gap without ticks, the world has stood still meanwhile


class StartPose(Section):
    """A pose in the world."""

    x: float = Field(ge=-1e4, le=1e4, description="m")
    y: float = Field(ge=-1e4, le=1e4, description="m")
    yaw: float = Field(0.0, ge=-2 * pi, le=2 * pi, description="rad")


class SimConfig(Section):
    """The simulator."""

    world: str = Field(
        "office",
        description="a name in config/worlds, the path of a world or of a ROS map, barn:N, building:N or crowd:N",
    )
    barn_file: str = Field("", description="path of the list of cylinders for `world: barn:N`")
    seed: int = Field(0, ge=0, le=2**31, description="of noise, slip, people and loose things")
    start: StartPose | None = Field(None, description="where the robot starts; none: where the world says")
    clutter_jitter: float = Field(0.1, ge=0, le=1, description="m by which loose things move from seed to seed")
    people_react: bool = Field(True, description="whether people stop for the robot and walk around it")
    hardware: Literal["messages", "emulated"] = Field(
        "messages", description="messages: board and scan as such; emulated: byte streams on ports, as the robot's"
    )
    emulation: EmulationConfig = EmulationConfig()
    drive: DriveTruth = Field(DriveTruth(), description="the drive as it really is")
    battery: Battery = Field(Battery(), description="the battery")
    laser: LaserNoise = Field(LaserNoise(), description="errors of the laser")
    ranges: RangeNoise = Field(RangeNoise(), description="errors of ultrasonic and infrared sensors")


class SimService(Service):
    """One robot in one world. Physics runs on a fixed grid of 5 ms from the first event on."""

    config_type = SimConfig

    def __init__(self, config: SimConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        start = Pose2(config.start.x, config.start.y, config.start.yaw) if config.start else None
        self.world: World = load(config.world, config.seed, config.clutter_jitter, config.barn_file, start)
        self.cells = self.world.cells
        corners = robot.corners
        self.body = dyn.Body(corners, grown(corners, dyn.TOUCH), grown(corners, dyn.RELEASE))
        pose = self.world.start
        self.people = self._people()
        middle = np.array([[pose.x, pose.y]])
        if self.world.solid_at(middle)[0] or touches_world(placed(corners, pose.x, pose.y, pose.yaw), self.cells):
            raise UserError(
                f"world {config.world}: the robot does not fit at its start ({pose.x:g}, {pose.y:g})",
                "move the world's `start:`, or set `start:` in section `sim`",
            )
        self.wheels = true_wheels(robot.drive, config.drive, dyn.DT)
        self.slip_rng, self.laser_rng, self.range_rng, once = (
            np.random.default_rng([config.seed, stream]) for stream in (3, 4, 5, 6)
        )
        self.first_counts = [int(n) for n in once.integers(robot.drive.encoder_wrap, size=2)]
        self.state_now = np.zeros(14)
        self.state_now[:3] = pose.x, pose.y, pose.yaw
        self.targets = np.zeros(2)
        self.life = 0  # steps that the command has left
        emulated = config.hardware == "emulated"
        self.emulation = Emulation(config.emulation, robot, config.seed) if emulated else None
        self.faults = MessageFaults(robot, config.seed)
        self.used = 0.0  # Ah
        steps_back = ceil(robot.laser.scan_time / dyn.DT) + CATCH_UP_STEPS + 4
        self.history = np.zeros((steps_back, 3 + 3 * len(self.world.people)))
        kinds = [s.kind for s in robot.ranges]
        self.n_ultrasonic = kinds.count("ultrasonic")
        self.range_sensors = [s for kind in ("ultrasonic", "infrared") for s in robot.ranges if s.kind == kind]
        self.cone_table = np.array(
            [(s.mount.x, s.mount.y, s.mount.yaw, s.field_of_view, s.range_max) for s in self.range_sensors], float
        ).reshape(-1, 5)
        self.epoch: int | None = None  # ns: time of step 0
        self.step = 0
        self.sweep = 0  # number of the next sweep since the epoch

    def warm(self) -> None:
        """Compiles the kernels on copies."""
        dyn.advance(
            0, 1, self.state_now.copy(), self.targets, 1, np.zeros((1, 2)), self.wheels, self.body, self.cells,
            self._people(), self.history.copy(),
        )  # fmt: skip
        self._true_sweep(0)
        cones(self.cells, self.history[0], self.cone_table, self.config.ranges.n_rays)

    def _people(self) -> crowd.People:
        start = self.world.start
        return crowd.started(self.world.people, self.config.people_react, self.config.seed, (start.x, start.y))

    def state(self) -> str:
        return f"{self.world.name}, {int(self.state_now[dyn.N_CONTACTS])} contacts"

    @property
    def time(self) -> int:
        """ns: until when the physics has run."""
        return (self.epoch or 0) + self.step * dyn.DT_NS

    @property
    def ports(self) -> dict[str, PortConfig]:
        return self.emulation.ports if self.emulation is not None else {}

    @on(topics.RX)
    def bytes_came(self, data: SerialData) -> Out:
        """A driver wrote to the emulated hardware."""
        if self.emulation is not None:
            self._catch_up()
            yield from self.emulation.receive(data, self.now)
            self._obey_board(self.emulation)

    @answer(requests.FAULT)
    def broken(self, order: Break) -> Answer[Reply]:
        """`zenav fault`: something of the simulated hardware breaks, or is repaired."""
        emulation = self.emulation
        faults = emulation.faults if emulation else self.faults.holds
        reply = breaking.broken(faults, emulation is not None, order, self.now)
        if emulation is not None:
            yield from emulation.plugs(self.now)
        return reply

    @on(topics.MOTORS)
    def motors(self, command: MotorCommand) -> Out:
        if self.emulation is not None:
            return ()
        self._catch_up()
        self.targets[:] = wheel_targets(command.left, command.right, self.robot.drive)
        life = self.config.drive.command_life
        self.life = 2**62 if life is None else ceil(life / dyn.DT)
        return ()

    @every(hz=50)
    def tick(self) -> Out:
        self._catch_up()
        if self.emulation is None:
            self.faults.holds.pass_to(self.now)
            sent = (self.faults.scan(scan) for scan in self._due_scans())
            yield from (topics.SCAN(scan) for scan in sent if scan is not None)
            yield topics.BOARD(self.faults.board(self._board()))
        else:
            yield from self.emulation.plugs(self.now)
            self._obey_board(self.emulation)
            yield from self.emulation.sweep_chunks(self._due_scans(), self.now)
            yield from self.emulation.measured(self._board(), self.now)
        yield topics.TRUTH(self._truth())
        yield topics.CLOCK(Clock(self.now, 1.0))

    def _obey_board(self, emulation: Emulation) -> None:
        """The wheels turn as the emulated board drives its motors, for as long as its command holds."""
        left, right, life = emulation.board.motors(self.now)
        self.targets[:] = wheel_targets(left, right, self.robot.drive)
        self.life = 2**62 if life is None else ceil(life / dyn.DT_NS)

    def _catch_up(self) -> None:
        """Runs the physics up to now; starts anew on its grid where the clock jumped."""
        behind = 0 if self.epoch is None else (self.now - self.time) // dyn.DT_NS
        if self.epoch is None or not -1 <= behind <= CATCH_UP_STEPS:
            self._restart_time()
            return
        n = max(int(behind), 0)
        dyn.advance(
            self.step, n, self.state_now, self.targets, self.life, self.slip_rng.standard_normal((n, 2)), self.wheels,
            self.body, self.cells, self.people, self.history,
        )  # fmt: skip
        self.step += n
        self.life = max(self.life - n, 0)
        amperes = float(self._currents().sum()) + self.config.battery.idle_current
        self.used += amperes * n * dyn.DT / 3600

    def _restart_time(self) -> None:
        self.epoch, self.step, self.sweep = self.now, 0, 0
        self.history[:, :3] = self.state_now[:3]
        self.history[:, 3:] = self.people.state[:, :3].ravel()

    def _due_scans(self) -> list[LaserScan]:
        """The sweeps whose last beam has been taken."""
        laser, scans = self.robot.laser, []
        while (begin := int(self.sweep * 1e9 / laser.rate)) + laser.scan_time * 1e9 <= self.step * dyn.DT_NS:
            self.sweep += 1
            if begin // dyn.DT_NS < self.step - len(self.history) + 2:
                continue  # no tick came for so long that the history has forgotten it
            true = self._true_sweep(begin)
            ranges = measured(true, self.config.laser, laser.range_min, laser.range_max, self.laser_rng)
            stamp = (self.epoch or 0) + begin
            increment = laser.angle_increment
            scans.append(
                LaserScan(stamp, laser.angle_min, increment, laser.scan_time, laser.range_min, laser.range_max, ranges)
            )
        return scans

    def _true_sweep(self, begin: int) -> NDArray[np.float64]:
        """The ranges of the sweep that begins `begin` ns after the epoch."""
        laser = self.robot.laser
        mount = laser.mount.x, laser.mount.y, laser.mount.yaw
        beam_step = laser.scan_time / (laser.n_beams - 1) / dyn.DT
        limit = laser.range_max + 5 * self.config.laser.sigma
        return sweep(
            self.cells, self.history, begin / dyn.DT_NS, beam_step, mount, laser.angle_min, laser.angle_increment,
            laser.n_beams, limit,
        )  # fmt: skip

    def _currents(self) -> NDArray[np.float32]:
        s = self.state_now
        targets = self.targets if self.life else np.zeros(2)
        return motor_currents(s[dyn.LEFT_SPEED : dyn.RIGHT_SPEED + 1], targets, self.wheels.limit, s[dyn.CONTACT] > 0)

    def _board(self) -> BoardReport:
        s, drive = self.state_now, self.robot.drive
        at = self.history[self.step % len(self.history)]
        true = cones(self.cells, at, self.cone_table, self.config.ranges.n_rays)
        reach = self.cone_table[:, 4]
        ranges = measured(true, self.config.ranges, 0.0, reach, self.range_rng)
        currents = self._currents()
        left, right = -drive.motor_direction, drive.motor_direction  # signs of the board's encoders
        per_radian = drive.counts_per_turn / (2 * pi)
        return BoardReport(
            self.time,
            encoder_counts(left * s[dyn.LEFT_ANGLE], self.first_counts[0], drive),
            encoder_counts(right * s[dyn.RIGHT_ANGLE], self.first_counts[1], drive),
            float(np.rint(left * s[dyn.LEFT_SPEED] * per_radian)),
            float(np.rint(right * s[dyn.RIGHT_SPEED] * per_radian)),
            ranges[: self.n_ultrasonic],
            ranges[self.n_ultrasonic :],
            battery_voltage(self.config.battery, self.used, float(currents.sum()) + self.config.battery.idle_current),
            currents,
        )

    def _truth(self) -> Truth:
        s = self.state_now
        pose = Pose2(float(s[dyn.X]), float(s[dyn.Y]), wrapped(float(s[dyn.YAW])))
        at = self.people.state
        return Truth(
            self.time,
            pose,
            self.world.start,
            float(s[dyn.V]),
            float(s[dyn.W]),
            bool(s[dyn.CONTACT]),
            int(s[dyn.N_CONTACTS]),
            float(s[dyn.DISTANCE]),
            at[:, crowd.X].astype(np.float32),
            at[:, crowd.Y].astype(np.float32),
        )
