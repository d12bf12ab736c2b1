# SPDX-License-Identifier: Apache-2.0
"""What navigator and guard say of a task, for tools and pages."""

from shared.messages import GuardState, GuardStatus, NavState, NavStatus
from shared.reasons import reason_text

FINAL_STATES = (NavState.REACHED, NavState.FAILED, NavState.CANCELED)


def stop_reason(nav: NavStatus | None, guard: GuardStatus | None) -> str:
    """Why the robot stands or is slow, in words; empty when it just drives."""
    if guard is not None and guard.reason and guard.state is not GuardState.IDLE:
        return reason_text(guard.reason) + (f" ({guard.detail})" if guard.detail else "")
    if nav is None or not nav.reason:
        return f"recovery: {nav.recovery}" if nav is not None and nav.recovery else ""
    reason = reason_text(nav.reason)
    return f"{reason}; recovery: {nav.recovery}" if nav.recovery else reason
