# SPDX-License-Identifier: Apache-2.0
"""The topic of keyframes and closures: published while somebody watches, and what the graph holds."""

from itertools import pairwise

import numpy as np
import pytest

from services.mapper.back_end.graph_topic import PERIOD_NS, GraphTopic, keyframe_graph
from services.mapper.back_end.pose_graph import PoseGraph
from shared.geometry import Pose2
from shared.requests import Watch


def graph_of_a_square() -> PoseGraph:
    """Five keyframes, one removed, and a closure from the last to the first."""
    graph = PoseGraph()
    names = [graph.add_node(Pose2(x, y, 0.0)) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0.1))]
    for i, j in pairwise(names):
        graph.add_edge(i, j, graph.pose(i).inverse() @ graph.pose(j), np.eye(3), loop=False)
    graph.add_edge(names[0], names[4], Pose2(0.0, 0.1, 0.0), np.eye(3), loop=True)
    graph.remove_node(names[2])
    return graph


def asked(topic: GraphTopic, seconds: float, now: int) -> None:
    with pytest.raises(StopIteration) as ended:
        next(topic.watch(Watch(now, seconds), now))
    assert ended.value.value.accepted


def test_closures_lie_between_their_keyframes():
    message = keyframe_graph(graph_of_a_square(), 5)
    np.testing.assert_allclose(message.xs, [0, 1, 0, 0])
    np.testing.assert_allclose(message.ys, [0, 0, 1, 0.1], rtol=1e-6)
    closure = [message.from_xs, message.from_ys, message.to_xs, message.to_ys, message.accepted]
    np.testing.assert_allclose(np.concatenate(closure), [0, 0, 0, 0.1, 1], rtol=1e-6)


def test_an_empty_graph_is_a_message_too():
    message = keyframe_graph(PoseGraph(), 5)
    assert len(message.xs) == len(message.from_xs) == 0


def test_it_is_published_while_somebody_watches_and_not_more_often_than_its_period():
    topic, graph, step = GraphTopic(), graph_of_a_square(), 500_000_000
    assert list(topic.publications(graph, 0)) == []
    asked(topic, 5.0, 10)
    sent = [now for now in range(10, 10 + 20 * step, step) if list(topic.publications(graph, now))]
    assert sent == [10, 10 + PERIOD_NS, 10 + 2 * PERIOD_NS]
    asked(topic, 5.0, 20 * step)
    asked(topic, 0.0, 20 * step + 1)
    assert list(topic.publications(graph, 21 * step)) == []
