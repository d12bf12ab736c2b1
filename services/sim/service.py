# SPDX-License-Identifier: Apache-2.0
"""Simulator of the hardware: `hardware/motors` in; `hardware/board`, `scan`, the truth and the clock out."""

from math import ceil

import numpy as np
from numpy.typing import NDArray

from services.sim import dynamics as dyn
from services.sim import fault_requests
from services.sim import people as pedestrians
from services.sim.board import SimulatedBoard
from services.sim.config import SimConfig
from services.sim.contact import offset_polygon, touches_world, transform_polygon
from services.sim.contact_sensors import ContactSensors
from services.sim.drive import motor_currents, true_wheels, wheel_targets
from services.sim.hardware.emulation import Emulation
from services.sim.imu import SimulatedImu
from services.sim.laser import simulated_lasers
from services.sim.message_faults import MessageFaults
from services.sim.other_robots import place_discs, with_discs
from services.sim.truth import true_state
from services.sim.velocity_base import rim_turns
from services.sim.world import World
from services.sim.world_loader import load_world
from shared import requests, topics
from shared.config import Robot, UserError
from shared.geometry import Pose2
from shared.messages import BoardReport, Clock, Contacts, Imu, LaserScan, MotorCommand, RobotDiscs, SerialData, Velocity
from shared.ports import PortConfig
from shared.requests import Break, Reply
from shared.service import Answer, Out, Service, answer, every, on
from shared.topics import Publication

CATCH_UP_STEPS = 100  # 0.5 s; during a longer gap without ticks the world stands still


class SimService(Service):
    """One robot in one world. The physics runs in fixed steps of 5 ms from the first event on."""

    config_type = SimConfig

    def __init__(self, config: SimConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        start = Pose2(config.start.x, config.start.y, config.start.yaw) if config.start else None
        self.world: World = load_world(config.world, config.seed, config.clutter_jitter, config.barn_file, start)
        self.cells = self.world.cells
        corners = robot.corners
        self.body = dyn.Body(corners, offset_polygon(corners, dyn.CONTACT_M), offset_polygon(corners, dyn.RELEASE_M))
        pose = self.world.start
        self.people = with_discs(self._people(), config.other_discs)
        middle = np.array([[pose.x, pose.y]])
        footprint = transform_polygon(corners, pose.x, pose.y, pose.yaw)
        if self.world.solid_at(middle)[0] or touches_world(footprint, self.cells):
            raise UserError(
                f"world {config.world}: the robot does not fit at its start ({pose.x:g}, {pose.y:g})",
                "move the world's `start:`, or set `start:` in section `sim`",
            )
        self.wheels = true_wheels(robot.drive, config.drive, dyn.DT)
        self.slip_rng, range_rng, once = (np.random.default_rng([config.seed, stream]) for stream in (3, 5, 6))
        self.board = SimulatedBoard(config, robot, range_rng, once)
        self.state_now = np.zeros(14)
        self.state_now[:3] = pose.x, pose.y, pose.yaw
        self.targets = np.zeros(2)
        self.command_steps = 0  # remaining steps of the command
        emulated = config.hardware == "emulated"
        self.emulation = Emulation(config.emulation, robot, config.seed) if emulated else None
        self.faults = MessageFaults(robot, config.seed)
        steps_back = ceil(max(laser.scan_time for laser in robot.all_lasers) / dyn.DT) + CATCH_UP_STEPS + 4
        self.history = np.zeros((steps_back, 3 + 3 * len(self.people.state)))
        self.epoch: int | None = None  # ns: time of step 0
        self.step, self.measured_at = 0, -1  # ns: time of the last reports
        self.lasers = simulated_lasers(robot, config.laser, config.seed)
        self.imu = SimulatedImu(config.imu, np.random.default_rng([config.seed, 10])) if robot.imu else None
        self.contact_sensors = ContactSensors(robot, self.world.cliffs)

    def warm_up(self) -> None:
        """Compiles the kernels on copies."""
        dyn.advance(
            0, 1, self.state_now.copy(), self.targets, 1, np.zeros((1, 2)), self.wheels, self.body, self.cells,
            self._people(), self.history.copy(),
        )  # fmt: skip
        for laser in self.lasers.values():
            laser.true_sweep(self.cells, self.history, 0)
        self._contacts()
        self.board.warm_up(self.cells, self.history[0])

    def _people(self) -> pedestrians.People:
        start = self.world.start.x, self.world.start.y
        return pedestrians.initial_people(self.world.people, self.config.people_react, self.config.seed, start)

    def state(self) -> str:
        return f"{self.world.name}, {int(self.state_now[dyn.N_CONTACTS])} contacts"

    @property
    def time(self) -> int:
        """Time of the physics, ns."""
        return (self.epoch or 0) + self.step * dyn.DT_NS

    @property
    def ports(self) -> dict[str, PortConfig]:
        return self.emulation.ports if self.emulation is not None else {}

    @on(topics.RX)
    def receive_bytes(self, data: SerialData) -> Out:
        """Passes bytes of a driver to the emulated hardware."""
        if self.emulation is not None:
            self._catch_up()
            yield from self.emulation.receive(data, self.now)
            self._obey_board(self.emulation)

    @answer(requests.FAULT)
    def handle_fault_request(self, order: Break) -> Answer[Reply]:
        """Begins or ends a fault of the simulated hardware: `zenav fault`."""
        emulation = self.emulation
        faults = emulation.faults if emulation else self.faults.active
        reply = fault_requests.apply_fault_request(faults, emulation is not None, self.robot, order, self.now)
        if emulation is not None:
            yield from emulation.update_plugs(self.now)
        return reply

    @on(topics.OTHERS)
    def others(self, others: RobotDiscs) -> Out:
        """Lets the laser see and the body touch what the other robots of this world are now."""
        self._catch_up()
        place_discs(self.people.state[len(self.world.people) :], others, self.body.footprint, self.state_now[:3])
        return ()

    @on(topics.MOTORS)
    def motors(self, command: MotorCommand) -> Out:
        """Takes the command of a base that counts its wheels."""
        if self.emulation is None or self.emulation.board is None:
            self._take_command(*wheel_targets(command.left, command.right, self.robot.drive))
        return ()

    @on(topics.VELOCITY)
    def velocity(self, command: Velocity) -> Out:
        """Takes the command of a base that controls its own speed."""
        if self.emulation is None or self.emulation.board is None:
            self._take_command(*rim_turns(command.v, command.w, self.robot.drive))
        return ()

    def _take_command(self, left: float, right: float) -> None:
        """Sets the speeds of both wheels, rad/s."""
        self._catch_up()
        self.targets[:] = left, right
        life = self.config.drive.command_life
        self.command_steps = 2**62 if life is None else ceil(life / dyn.DT)

    @every(hz=50)
    def tick(self) -> Out:
        self._catch_up()
        if self.time == self.measured_at:
            return  # the tick before was late: nothing is measured twice at one time
        self.measured_at = self.time
        if self.emulation is None:
            self.faults.active.expire(self.now)
            for topic, scans in ((topics.SCAN, self._due_scans()), (topics.SCAN_2, self._due_scans_2())):
                sent = (self.faults.scan(scan, topic.key) for scan in scans)
                yield from (topic(scan) for scan in sent if scan is not None)
            yield self._base_report()
            yield from self._body_sensors()
        else:
            yield from self.emulation.update_plugs(self.now)
            self._obey_board(self.emulation)
            yield from self.emulation.send_sweeps(self._due_scans(), self._due_scans_2(), self.now)
            imu, contacts = self._imu(), self._contacts()
            if self.emulation.board is not None:
                yield from self.emulation.send_report(self._board(), imu, contacts, self.now)
            else:
                yield self._base_report()
            yield from self.emulation.send_body(imu, contacts if self.robot.has_contacts else None, self.now)
        yield topics.TRUTH(true_state(self.time, self.state_now, self.world, self.people))
        yield topics.CLOCK(Clock(self.now, 1.0))

    def _body_sensors(self) -> Out:
        """The inertial sensor and the contact sensors of a robot that has them."""
        if (reading := self.faults.imu(self._imu())) is not None:
            yield topics.IMU(reading)
        if self.robot.has_contacts and (contacts := self.faults.contacts(self._contacts())) is not None:
            yield topics.CONTACTS(contacts)

    def _imu(self) -> Imu | None:
        s = self.state_now
        return self.imu.measure(self.time, float(s[dyn.YAW]), float(s[dyn.V])) if self.imu is not None else None

    def _contacts(self) -> Contacts:
        pose = Pose2(*self.state_now[[dyn.X, dyn.Y, dyn.YAW]].tolist())
        return self.contact_sensors.contacts(
            self.time, pose, self.cells, self.people.state[:, : pedestrians.RADIUS + 1]
        )

    def _obey_board(self, emulation: Emulation) -> None:
        """Sets the wheels' targets from the emulated board's motor command, for its remaining time."""
        if emulation.board is None:
            return
        left, right, command_steps = emulation.board.motors(self.now)
        self.targets[:] = wheel_targets(left, right, self.robot.drive)
        self.command_steps = 2**62 if command_steps is None else ceil(command_steps / dyn.DT_NS)

    def _catch_up(self) -> None:
        """Runs the physics up to now; after a jump of the clock, restarts its time."""
        behind = 0 if self.epoch is None else (self.now - self.time) // dyn.DT_NS
        if self.epoch is None or not -1 <= behind <= CATCH_UP_STEPS:
            self._restart_time()
            return
        n = max(int(behind), 0)
        dyn.advance(
            self.step, n, self.state_now, self.targets, self.command_steps, self.slip_rng.standard_normal((n, 2)),
            self.wheels, self.body, self.cells, self.people, self.history,
        )  # fmt: skip
        self.step += n
        self.command_steps = max(self.command_steps - n, 0)
        self.board.discharge(self._currents(), n * dyn.DT)

    def _restart_time(self) -> None:
        self.epoch, self.step = self.now, 0
        for laser in self.lasers.values():
            laser.sweep = 0
        if self.imu is not None:
            self.imu.restart()
        self.history[:, :3] = self.state_now[:3]
        self.history[:, 3:] = self.people.state[:, :3].ravel()

    def _due_scans(self) -> list[LaserScan]:
        """The first laser's sweeps that are complete since the last call."""
        return self.lasers[topics.SCAN.key].due_scans(self.cells, self.history, self.step, self.epoch or 0)

    def _due_scans_2(self) -> list[LaserScan]:
        laser = self.lasers.get(topics.SCAN_2.key)
        return laser.due_scans(self.cells, self.history, self.step, self.epoch or 0) if laser is not None else []

    def _currents(self) -> NDArray[np.float32]:
        s = self.state_now
        targets = self.targets if self.command_steps else np.zeros(2)
        return motor_currents(s[dyn.LEFT_SPEED : dyn.RIGHT_SPEED + 1], targets, self.wheels.limit, s[dyn.CONTACT] > 0)

    def _board(self) -> BoardReport:
        row = self.history[self.step % len(self.history)]
        return self.board.report(self.time, self.state_now, row, self.cells, self._currents())

    def _base_report(self) -> Publication:
        """The board's report, or the odometry of a base that controls its own speed."""
        if self.robot.drive.kind == "velocity":
            return topics.BASE_MOTION(self.board.odometry(self.time, self.epoch or 0, self.state_now, self._currents()))
        return topics.BOARD(self.faults.board(self._board()))
