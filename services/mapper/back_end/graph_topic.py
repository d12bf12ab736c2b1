# SPDX-License-Identifier: Apache-2.0
"""The debug topic of the mapper: keyframes and loop closures, published only while a client watches."""

import numpy as np

from services.mapper.back_end.pose_graph import PoseGraph
from shared import topics
from shared.messages import KeyframeGraph
from shared.service import Out
from shared.watched_topic import WatchedTopic

PERIOD_NS = 2_000_000_000  # between two messages


class GraphTopic(WatchedTopic):
    """When the topic is due, and its message."""

    def __init__(self) -> None:
        super().__init__(PERIOD_NS)

    def publications(self, graph: PoseGraph, now: int) -> Out:
        """The topic, where it is due at `now` (ns)."""
        if self.is_due(now):
            yield topics.GRAPH(keyframe_graph(graph, now))


def keyframe_graph(graph: PoseGraph, now: int) -> KeyframeGraph:
    """The message of a graph. Edges between neighbours are left out: they lie along the path."""
    snapshot = graph.snapshot()
    places = snapshot.poses[:, :2].astype(np.float32)
    one, other = (places[rows[snapshot.loop]] for rows in snapshot.rows())
    return KeyframeGraph(
        stamp=now, xs=places[:, 0], ys=places[:, 1],
        from_xs=one[:, 0], from_ys=one[:, 1], to_xs=other[:, 0], to_ys=other[:, 1],
        accepted=snapshot.on[snapshot.loop].astype(np.int8),
    )  # fmt: skip
