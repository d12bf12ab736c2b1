# SPDX-License-Identifier: Apache-2.0
"""Which type of velocity does a driven robot subscribe to? Its tokens say it, and only that type is published.

A publisher of a type that has no subscriber would confuse the tools of ROS, which allow one type for a name.
"""

from services.ros2.rmw_names import Endpoint, Entity, RosName


class CommandSubscribers:
    """Subscriptions of other nodes by their tokens. topics: name, type and hash of each of our publishers, by label."""

    def __init__(self, topics: dict[str, RosName]) -> None:
        self._topics = topics
        self._tokens: dict[str, str] = {}  # label by token

    def update(self, token: str, endpoint: Endpoint, is_there: bool) -> None:
        """A token came or went. An endpoint without a hash is of any."""
        if not is_there:
            self._tokens.pop(token, None)
            return
        theirs = endpoint.topic
        for label, topic in self._topics.items():
            fits = (theirs.name, theirs.type) == (topic.name, topic.type) and theirs.hash in ("", topic.hash)
            if fits and endpoint.entity is Entity.SUBSCRIPTION:
                self._tokens[token] = label

    @property
    def labels(self) -> frozenset[str]:
        """The publishers that have a subscriber."""
        return frozenset(self._tokens.values())
