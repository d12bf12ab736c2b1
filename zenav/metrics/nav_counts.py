# SPDX-License-Identifier: Apache-2.0
"""Goals and recoveries of a drive, counted from the navigator's status."""

from dataclasses import dataclass

from shared.messages import NavState, NavStatus


@dataclass
class NavCounts:
    """Goals that were reached and that failed, and recoveries, of all tasks together; `add` each status in order."""

    n_reached: int = 0
    n_failed: int = 0
    n_recoveries: int = 0
    last: NavStatus | None = None

    def add(self, status: NavStatus) -> None:
        before = self.last
        is_new = before is None or (before.task_id, before.state) != (status.task_id, status.state)
        self.n_reached += is_new and status.state is NavState.REACHED
        self.n_failed += is_new and status.state is NavState.FAILED
        if before is None or before.task_id != status.task_id:
            self.n_recoveries += status.n_recoveries
        else:
            self.n_recoveries += max(status.n_recoveries - before.n_recoveries, 0)
        self.last = status
