# SPDX-License-Identifier: Apache-2.0
"""What crosses the link of a robot to a site, as keys without the robot's name: from the registries' columns."""

from shared.requests import REQUESTS
from shared.topics import KEYS, LATCHED_KEYS, TOPICS, Topic, topic_of

PRESENCE = "@up"
"""Second part of the key of a robot's liveliness token (shared/runners/presence.py)."""


def _crosses(key: str, inward: bool) -> bool:
    topic = topic_of(key)
    return topic is not None and topic.crosses is not None and topic.crosses.inward == inward


OUTWARD_KEYS = tuple(key for key in KEYS if _crosses(key, inward=False))
"""Of topics that a robot sends to the site."""
INWARD_KEYS = tuple(key for key in KEYS if _crosses(key, inward=True))
"""Of topics that the site sends to a robot."""
SHARED_KEYS = tuple(topic.from_robots for topic in TOPICS if topic.from_robots in OUTWARD_KEYS)
"""Of topics that each robot at the site hears from all others."""
CROSSING_REQUESTS = tuple(row for row in REQUESTS if row.crosses)
SERVED_KEYS = (
    *(key for key in OUTWARD_KEYS if key in LATCHED_KEYS),
    *(key for row in CROSSING_REQUESTS for key in row.keys),
)
"""What a robot answers at the site: last values, and requests."""


def crossing_text(topic: Topic) -> str:  # type: ignore[type-arg]  # of any message
    """The most messages a second at rest, driving and watched, for tables; empty where nothing crosses."""
    row = topic.crosses
    if row is None:
        return ""
    return "inward" if row.inward else f"{row.rest:g} / {row.driving:g} / {row.watched:g}"
