# SPDX-License-Identifier: Apache-2.0
"""What the navigator orders: goals and recoveries, two topics with one count."""

from shared.messages import Goal, Recovery
from shared.stamps import precedes

Order = Goal | Recovery


def is_newer(order: Order, last: Order | None, now: int) -> bool:
    """Whether an order replaces the last one: it has a higher id, or comes of a navigator with a clock set back.

    The two topics may arrive in another order than they were sent in, so the id decides. now: ns.
    """
    if last is None:
        return True
    if order.id == last.id:
        return type(order) is not type(last)
    return order.id > last.id or not precedes(order.stamp, last.stamp, now)
