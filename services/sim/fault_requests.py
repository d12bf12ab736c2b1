# SPDX-License-Identifier: Apache-2.0
"""Handles `request/fault`: the faults of the present kind of hardware, and their begin and end."""

from collections.abc import Callable
from enum import StrEnum

from services.sim.hardware.faults import FAULT_DESCRIPTIONS, ActiveFaults, Fault
from services.sim.message_faults import MESSAGE_FAULT_DESCRIPTIONS, MessageFault
from shared import reasons
from shared.config import Robot, nearest
from shared.lasers import NO_SECOND_LASER
from shared.requests import Break, Reply

ALL_FAULTS: dict[StrEnum, str] = dict([*FAULT_DESCRIPTIONS.items(), *MESSAGE_FAULT_DESCRIPTIONS.items()])
"""Fault -> description."""

BREAKABLE: tuple[tuple[str, Callable[[Robot], bool], str], ...] = (
    ("scan_2_", lambda robot: len(robot.all_lasers) > 1, f"{NO_SECOND_LASER}; zenav up --robot delivery has one"),
    ("laser_2_", lambda robot: len(robot.all_lasers) > 1, f"{NO_SECOND_LASER}; zenav up --robot delivery has one"),
    ("imu_", lambda robot: robot.imu is not None, "there is no robot.imu; zenav up --set robot.imu={}"),
    ("bumper", lambda robot: bool(robot.bumpers), "robot.bumpers is empty; zenav up --robot turtlebot2 has some"),
    ("cliff", lambda robot: bool(robot.cliffs), "robot.cliffs is empty; zenav up --robot turtlebot2 has some"),
    (
        "estop_input",
        lambda robot: robot.estop_input,
        "robot.estop_input is false; zenav up --set robot.estop_input=true",
    ),
)
"""Start of faults' names, whether a robot has what they break, and what is missing with a hint."""


def apply_fault_request(faults: ActiveFaults, emulated: bool, robot: Robot, request: Break, now: int) -> Reply:
    """Begins or ends a fault at `now` (ns); returns the reply. emulated: whether the hardware is byte streams."""
    table: type[Fault] | type[MessageFault] = Fault if emulated else MessageFault
    names = tuple(table)
    if request.fault not in names and not (request.mended and not request.fault):
        if request.fault in tuple(ALL_FAULTS):
            needed, option = ("messages", "messages") if emulated else ("emulated hardware", "emulated")
            why = f"{request.fault} is a fault of {needed}: zenav up --hardware {option}"
        else:
            why = f"no fault {request.fault!r}: {nearest(request.fault, names)}"
        return Reply(now, False, reasons.BAD_REQUEST.code, why)
    if request.mended:
        faults.clear(table(request.fault) if request.fault else None)
        return Reply(now, True, "", f"broken now: {faults}" if faults else "nothing is broken")
    fault = table(request.fault)
    for prefix, has_part, missing in BREAKABLE:
        if fault.startswith(prefix) and not has_part(robot):
            return Reply(now, False, reasons.BAD_REQUEST.code, f"{fault} has no effect: {missing}")
    faults.begin(fault, now + round(request.seconds * 1e9) if request.seconds else None)
    return Reply(now, True, "", ALL_FAULTS[fault])
