# SPDX-License-Identifier: Apache-2.0
"""Handles `request/fault`: the faults of the present kind of hardware, and their begin and end."""

from enum import StrEnum

from services.sim.hardware.faults import FAULT_DESCRIPTIONS, ActiveFaults, Fault
from services.sim.message_faults import MESSAGE_FAULT_DESCRIPTIONS, MessageFault
from shared import reasons
from shared.config import nearest
from shared.requests import Break, Reply

ALL_FAULTS: dict[StrEnum, str] = dict([*FAULT_DESCRIPTIONS.items(), *MESSAGE_FAULT_DESCRIPTIONS.items()])
"""Fault -> description."""


def apply_fault_request(faults: ActiveFaults, emulated: bool, request: Break, now: int) -> Reply:
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
    faults.begin(fault, now + round(request.seconds * 1e9) if request.seconds else None)
    return Reply(now, True, "", ALL_FAULTS[fault])
