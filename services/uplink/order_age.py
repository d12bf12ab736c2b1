# SPDX-License-Identifier: Apache-2.0
"""Whether an order of the site is recent enough to be obeyed."""

from shared.types import NS_PER_S

MAX_AHEAD_NS = NS_PER_S  # by which the sender's clock may be ahead of the robot's


def age_fault(sent: int, now: int, max_age: float) -> str:
    """Why an order that was sent at `sent` (ns) is not obeyed at `now` (ns); empty where it is. max_age: s."""
    age = (now - sent) / NS_PER_S
    if age > max_age:
        return f"sent {age:.1f} s ago, where {max_age:g} s are the limit"
    return f"dated {-age:.1f} s ahead of this robot's clock" if sent - now > MAX_AHEAD_NS else ""
