# SPDX-License-Identifier: Apache-2.0
"""STOP and its release: published again until the guard confirms it. Which release counts after several presses?"""

from dataclasses import replace

from shared.messages import EmergencyStop, GuardState, GuardStatus
from shared.types import NS_PER_S

REPEAT_NS = 100_000_000  # between two messages
LIMIT_NS = 3 * NS_PER_S  # until it counts as unconfirmed


def latched_press(press: EmergencyStop, before: EmergencyStop | None, now: int) -> EmergencyStop:
    """The press that holds: no release older than its stamp counts.  before: the press that held.  now: ns.

    A press that arrives late keeps the stamp of a newer one. Where the sender's clock is ahead, the arrival counts.
    """
    stamp = press.stamp if before is None else max(press.stamp, before.stamp)
    return replace(press, stamp=min(stamp, now))


class StopButton:
    """The newest order of any page. Times are ns on the stack's clock."""

    def __init__(self) -> None:
        self.order: EmergencyStop | None = None
        """While the guard has not confirmed it: the order as it was first published."""
        self._sent_at = 0

    @property
    def is_pressing(self) -> bool:
        """Whether STOP is pressed and not yet confirmed."""
        return self.order is not None and self.order.pressed

    def set(self, pressed: bool, by: str, now: int) -> EmergencyStop:
        """Presses or releases STOP. Returns the message to publish."""
        self.order, self._sent_at = EmergencyStop(now, pressed, by), now
        return self.order

    def confirm(self, status: GuardStatus) -> None:
        """Ends the repetition where the guard's status is newer than the order and shows it."""
        order = self.order
        is_stopped = status.state is GuardState.STOPPED
        if order is not None and status.stamp >= order.stamp and is_stopped == order.pressed:
            self.order = None

    def tick(self, now: int) -> tuple[EmergencyStop | None, bool]:
        """The message to publish now, and whether the guard failed to confirm within the limit."""
        order = self.order
        if order is None:
            return None, False
        if not 0 <= now - order.stamp < LIMIT_NS:
            self.order = None
            return None, True
        if now - self._sent_at < REPEAT_NS:
            return None, False
        self._sent_at = now
        stamp = now if order.pressed else order.stamp  # a STOP that was pressed after the release holds
        return EmergencyStop(stamp, order.pressed, order.by), False
