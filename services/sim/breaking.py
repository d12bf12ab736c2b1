# SPDX-License-Identifier: Apache-2.0
"""`request/fault`: which faults there are with this hardware, and what the request does to them."""

from enum import StrEnum

from services.sim.hardware.faults import WORDS, Fault, Faults
from services.sim.message_faults import MESSAGE_WORDS, MessageFault
from shared import reasons
from shared.config import nearest
from shared.requests import Break, Reply

ALL: dict[StrEnum, str] = dict([*WORDS.items(), *MESSAGE_WORDS.items()])
"""Every fault with its words."""


def broken(faults: Faults, emulated: bool, order: Break, now: int) -> Reply:
    """Lets a fault begin or end; the reply. emulated: the hardware's bytes are, not its messages."""
    table: type[Fault] | type[MessageFault] = Fault if emulated else MessageFault
    names = tuple(table)
    if order.fault not in names and not (order.mended and not order.fault):
        if order.fault in tuple(ALL):
            needed, option = ("messages", "messages") if emulated else ("emulated hardware", "emulated")
            why = f"{order.fault} is a fault of {needed}: zenav up --hardware {option}"
        else:
            why = f"no fault {order.fault!r}: {nearest(order.fault, names)}"
        return Reply(now, False, reasons.BAD_REQUEST.code, why)
    if order.mended:
        faults.clear(table(order.fault) if order.fault else None)
        return Reply(now, True, "", f"broken now: {faults}" if faults else "nothing is broken")
    fault = table(order.fault)
    faults.begin(fault, now + round(order.seconds * 1e9) if order.seconds else None)
    return Reply(now, True, "", ALL[fault])
