# SPDX-License-Identifier: Apache-2.0
"""The line of a sensor at a serial port, for its driver: open or closed, silent, without sense, and what the log says.

All times are ns. The rules are our own.
"""

from shared.messages import PortState
from shared.ports import PortConfig
from shared.service import Log, Out


class SensorLine:
    """State of one line.

    why_closed: text of the cause while it is not open.  logged_fault: last fault that was logged; empty in order.
    """

    def __init__(self, port: PortConfig, section: str, label: str, silence: float) -> None:
        """section: of its settings, for hints.  label: of the sensor in the log.  silence: s without a byte."""
        self.label, self.silence = label, silence * 1e9
        self.open = False
        self.why_closed = "" if port.given else f"no port: set {section}.port.device"
        self.bytes_at, self.reading_at, self.opened_at, self.started_at = 0, 0, 0, 0
        self.logged_fault, self.n_readings_at_log = "", 0

    def update_port(self, state: PortState, now: int) -> bool:
        """Takes the state of the port. Returns whether the sensor must be started."""
        self.open, self.why_closed = state.open, state.detail or "its port is closed"
        if state.open:
            self.opened_at = now
        return state.open

    def add_bytes(self, now: int) -> None:
        """Bytes arrived. After a silence the line counts as opened: the first reading may still come."""
        if not self.open or now - self.bytes_at > self.silence:
            self.open, self.opened_at = True, now
        self.bytes_at = now

    def limit_times(self, now: int) -> None:
        """No time lies ahead, although the clock may have been set back."""
        times = self.bytes_at, self.reading_at, self.opened_at, self.started_at
        self.bytes_at, self.reading_at, self.opened_at, self.started_at = (min(at, now) for at in times)

    def is_silent(self, now: int) -> bool:
        """Whether no byte came for `silence`."""
        return now - max(self.bytes_at, self.opened_at) > self.silence

    def lacks_readings(self, now: int) -> bool:
        """Whether no reading came for twice `silence`."""
        return now - max(self.reading_at, self.opened_at) > 2 * self.silence

    def is_start_due(self, now: int) -> bool:
        """Whether an open line is silent since the sensor was started last."""
        return self.open and now - max(self.bytes_at, self.started_at) > self.silence

    def fault_log(self, fault: str, n_readings: int) -> Out:
        """Logs each change of the fault. It ends with the next reading, not with an answer.

        fault: the present one; empty in order.  n_readings: number of readings so far.
        """
        if fault and fault != self.logged_fault:
            yield Log("WARNING", f"{self.label}: {fault}")
            self.logged_fault, self.n_readings_at_log = fault, n_readings
        elif self.logged_fault and not fault and n_readings > self.n_readings_at_log:
            yield Log("INFO", f"{self.label}: in order again")
            self.logged_fault = ""
