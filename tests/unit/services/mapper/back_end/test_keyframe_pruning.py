# SPDX-License-Identifier: Apache-2.0
import numpy as np

from services.mapper.back_end.keyframe_pruning import redundant_keyframe
from services.mapper.back_end.pose_graph import PoseGraph
from shared.geometry import Pose2

MAX_KEYFRAMES, PLACE_SIZE, MIN_PATH = 4, 0.5, 12.0


def test_a_place_of_fixed_nodes_loses_only_what_the_robot_added():
    """As on the map of another program, whose keyframes are fixed: all of them stay, however often one passes."""
    graph = PoseGraph()
    for x in (0.0, 1.5, 3.0):
        graph.add_node(Pose2(x, 0, 0), fixed=True)
    driven, fixed_nodes, before = [0.0, 1.5, 3.0], graph.nodes.tolist(), 2
    for visit in range(3 * MAX_KEYFRAMES):
        pose = Pose2(3.0 + 0.01 * visit, 0.02, 0.1)
        node = graph.add_node(pose)
        graph.add_edge(before, node, graph.pose(before).inverse() @ pose, np.eye(3), loop=False)
        driven.append(driven[-1] + 20)
        before = node
        row = redundant_keyframe(graph, driven, MAX_KEYFRAMES, PLACE_SIZE, MIN_PATH, 0, [])
        if row is not None:
            graph.remove_node(int(graph.nodes[row]))
            del driven[row]
    assert graph.nodes[:3].tolist() == fixed_nodes
    assert graph.fixed.tolist() == [True] * 3 + [False] * MAX_KEYFRAMES
