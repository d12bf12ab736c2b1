# SPDX-License-Identifier: Apache-2.0
"""Pose graph: keyframes and constraints between them (Grisetti et al., "A tutorial on graph-based SLAM", 2010).

An edge is the pose of one node in another's frame with its information. Its residual is the (x, y, yaw) of
measured^-1 @ (i_from_map @ map_from_j), in the frame of j; chi2 is its squared Mahalanobis length. (gtsam 4.3 uses the
logarithm of that, which is equal to first order.)
"""

from dataclasses import dataclass, fields
from math import cos, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.geometry import Pose2, wrapped_all
from shared.types import Bools, Float64s, Int64s


@dataclass(frozen=True, slots=True)
class Graph:
    """Snapshot of a pose graph with n nodes and m edges: read-only arrays for a job or a file.

    nodes: (n,) int64 names, ascending.  poses: (n, 3) x, y, yaw in `map`.  fixed: (n,) bool, never moved.
    edges: (m,) int64 names, ascending.  i, j: (m,) int64 names of nodes.  relative: (m, 3) i_from_j.
    information: (m, 3, 3) of (x, y, yaw) in the frame of j.  loop: (m,) bool, the edge may be wrong.
    on: (m,) bool, False for a rejected edge.
    """

    nodes: Int64s
    poses: Float64s
    fixed: Bools
    edges: Int64s
    i: Int64s
    j: Int64s
    relative: Float64s
    information: Float64s
    loop: Bools
    on: Bools

    def __post_init__(self) -> None:
        for field in fields(self):
            getattr(self, field.name).flags.writeable = False

    def check(self) -> None:
        """Raises ValueError with the name of an invalid array, as a graph may come from a damaged file."""
        n, m = len(self.nodes), len(self.edges)
        shapes: dict[str, tuple[tuple[int, ...], Any]] = {
            "nodes": ((n,), np.int64), "poses": ((n, 3), np.float64), "fixed": ((n,), np.bool_),
            "edges": ((m,), np.int64), "i": ((m,), np.int64), "j": ((m,), np.int64),
            "relative": ((m, 3), np.float64), "information": ((m, 3, 3), np.float64),
            "loop": ((m,), np.bool_), "on": ((m,), np.bool_),
        }  # fmt: skip
        for name, (shape, dtype) in shapes.items():
            array = getattr(self, name)
            if array.shape != shape or array.dtype != dtype:
                raise ValueError(f"{name} is {array.dtype} {array.shape}, expected {np.dtype(dtype)} {shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} is not finite")
        for name in ("nodes", "edges"):
            if (np.diff(getattr(self, name)) <= 0).any():
                raise ValueError(f"{name} do not rise")
        if not np.isin(np.concatenate((self.i, self.j)), self.nodes).all() or (self.i == self.j).any():
            raise ValueError("an edge does not join two of the nodes")
        if not _is_positive_definite(self.information).all():
            raise ValueError("an edge's information is not symmetric and positive definite")

    def subgraph_before(self, node: int) -> "Graph":
        """Returns the nodes with names below `node`, and the edges between them."""
        n, within = int(np.searchsorted(self.nodes, node)), (self.i < node) & (self.j < node)
        nodes = {f.name: getattr(self, f.name)[:n].copy() for f in fields(self)[:3]}
        return Graph(**nodes, **{f.name: getattr(self, f.name)[within] for f in fields(self)[3:]})

    def rows(self) -> tuple[Int64s, Int64s]:
        """Returns the rows of each edge's i and j in `nodes`: two (m,) int64."""
        return np.searchsorted(self.nodes, self.i), np.searchsorted(self.nodes, self.j)


@dataclass(frozen=True, slots=True)
class OptimizationResult:
    """Result of an optimization, for the nodes and edges of its snapshot.

    poses: (n, 3) in `map`.  weights: (m,) of the robust kernel, 0 to 1; 0 is a rejected edge, odometry's is 1.
    chi2: (m,) of each edge at the end, also of rejected ones.
    before, after: sums of chi2 over the edges that are accepted at the end.
    moved: motion of the last node in `map`, which nodes that were added meanwhile follow.
    """

    nodes: Int64s
    poses: Float64s
    edges: Int64s
    weights: Float64s
    chi2: Float64s
    before: float
    after: float
    iterations: int
    moved: Pose2

    @property
    def on(self) -> Bools:
        """(m,) bool, which edges are accepted."""
        return self.weights > 0


class _Columns:
    """Arrays of one length that grow together, by doubling. The first one ascends."""

    def __init__(self, **columns: NDArray[Any]) -> None:
        self.arrays = {name: array.copy() for name, array in columns.items()}
        self.n = len(next(iter(columns.values())))

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.arrays[name][: self.n]

    def append(self, **row: Any) -> None:
        for name, array in self.arrays.items():
            if self.n == len(array):
                room = np.zeros((max(64, len(array)), *array.shape[1:]), array.dtype)
                array = self.arrays[name] = np.concatenate((array, room))
            array[self.n] = row[name]
        self.n += 1

    def keep(self, rows: Bools) -> None:
        n = int(rows.sum())
        for array in self.arrays.values():
            array[:n] = array[: self.n][rows]
        self.n = n


class PoseGraph:
    """Nodes (keyframes) and edges (constraints). The first node is fixed, and defines the frame `map`.

    The name of a node is the number that `add_node` returns. Names ascend and are never reused. So the result of a job
    for an older snapshot still fits, and a caller may store data of a node by its name.
    """

    def __init__(self) -> None:
        names, flags, poses = np.zeros(0, np.int64), np.zeros(0, np.bool_), np.zeros((0, 3))
        self._set(Graph(
            nodes=names, poses=poses, fixed=flags, edges=names.copy(), i=names.copy(), j=names.copy(),
            relative=poses.copy(), information=np.zeros((0, 3, 3)), loop=flags.copy(), on=flags.copy(),
        ))  # fmt: skip

    @classmethod
    def of(cls, graph: Graph) -> "PoseGraph":
        """Returns the pose graph of a snapshot. Raises ValueError if it is damaged."""
        graph.check()
        self = cls()
        self._set(graph)
        return self

    def _set(self, graph: Graph) -> None:
        self._nodes = _Columns(node=graph.nodes, pose=graph.poses, fixed=graph.fixed)
        self._edges = _Columns(
            edge=graph.edges, i=graph.i, j=graph.j, relative=graph.relative,
            information=graph.information, loop=graph.loop, on=graph.on,
        )  # fmt: skip
        self._next_node = int(graph.nodes[-1]) + 1 if len(graph.nodes) else 0
        self._next_edge = int(graph.edges[-1]) + 1 if len(graph.edges) else 0

    @property
    def nodes(self) -> Int64s:
        """Names (n,), ascending. A read-only view, valid until the next change."""
        return _read_only(self._nodes["node"])

    @property
    def poses(self) -> Float64s:
        """Poses (n, 3) x, y, yaw in `map`, in the order of `nodes`. A read-only view, valid until the next change."""
        return _read_only(self._nodes["pose"])

    @property
    def fixed(self) -> Bools:
        """(n,) which nodes never move, in the order of `nodes`. A read-only view, valid until the next change."""
        return _read_only(self._nodes["fixed"])

    @property
    def n_edges(self) -> int:
        """Number of edges, also of rejected ones."""
        return self._edges.n

    def pose(self, node: int) -> Pose2:
        """Returns map_from_base of a node. Raises KeyError for an unknown name."""
        return pose_of(self._nodes["pose"][self._row(node)])

    def reserve_names(self, until: int) -> None:
        """Leaves out names, so that the next node's name is `until` or higher."""
        self._next_node = max(self._next_node, until)

    def add_node(self, map_from_base: Pose2, fixed: bool = False) -> int:
        """Adds a node at a pose, and returns its name. The first node is always fixed."""
        name, pose = self._next_node, (map_from_base.x, map_from_base.y, map_from_base.yaw)
        self._nodes.append(node=name, pose=pose, fixed=fixed or self._nodes.n == 0)
        self._next_node += 1
        return name

    def add_edge(self, i: int, j: int, i_from_j: Pose2, information: Float64s, loop: bool) -> None:
        """Adds a constraint between two nodes, with information (3, 3) of (x, y, yaw) in the frame of j.

        loop: the constraint may be wrong; others (odometry, scan to scan) are never rejected.
        Raises ValueError unless i and j differ and the information is positive definite, KeyError for unknown names.
        """
        if i == j or not _is_positive_definite(np.asarray(information)[None]).all():
            raise ValueError(f"an edge from {i} to {j} with information {np.asarray(information).tolist()}")
        self._row(i), self._row(j)
        self._edges.append(
            edge=self._next_edge, i=i, j=j, relative=(i_from_j.x, i_from_j.y, i_from_j.yaw),
            information=information, loop=loop, on=True,
        )  # fmt: skip
        self._next_edge += 1

    def move_nodes(self, first: int, motion: Pose2) -> None:
        """Moves the nodes with names from `first` on as a rigid body: pose = motion @ pose."""
        rows = (self._nodes["node"] >= first) & ~self._nodes["fixed"]
        poses = self._nodes["pose"]
        poses[rows] = compose(np.array((motion.x, motion.y, motion.yaw)), poses[rows])

    def snapshot(self) -> Graph:
        """Returns a copy of the present graph."""
        return Graph(
            nodes=self._nodes["node"].copy(), poses=self._nodes["pose"].copy(), fixed=self._nodes["fixed"].copy(),
            edges=self._edges["edge"].copy(),
            **{name: self._edges[name].copy() for name in ("i", "j", "relative", "information", "loop", "on")},
        )  # fmt: skip

    def apply(self, result: OptimizationResult) -> None:
        """Applies the optimum of an earlier snapshot. Newer nodes move with the snapshot's last one."""
        names, poses, fixed = self._nodes["node"], self._nodes["pose"], self._nodes["fixed"]
        mine, theirs = _common_rows(names, result.nodes)
        poses[mine] = result.poses[theirs]
        if len(result.nodes):
            newer = (names > result.nodes[-1]) & ~fixed
            poses[newer] = compose(np.array((result.moved.x, result.moved.y, result.moved.yaw)), poses[newer])
        mine, theirs = _common_rows(self._edges["edge"], result.edges)
        self._edges["on"][mine] = result.on[theirs]

    def remove_node(self, node: int) -> None:
        """Marginalizes a node, with edges between its neighbours that replace it.

        Exact to first order between two neighbours (the Schur complement of a chain). The clique of more neighbours is
        sparsified to a tree of its most certain edges, similar to Kretzschmar and Stachniss (IJRR 2012). Odometry's
        neighbours are joined by odometry, the others to their most certain one. Of two edges between the same nodes
        only the more certain one stays, as both saw the same walls. So repeated drives leave no more edges than pairs
        of near nodes. Rejected closures are dropped. Raises ValueError for a fixed node.
        """
        row = self._row(node)
        if self._nodes["fixed"][row]:
            raise ValueError(f"node {node} is fixed: it holds the others in `map`")
        i, j, on = self._edges["i"], self._edges["j"], self._edges["on"]
        touching = (i == node) | (j == node)
        spokes = [_Spoke.of(self._edges, int(k), node) for k in np.flatnonzero(touching & on)]
        self._edges.keep(~touching)
        self._nodes.keep(np.arange(self._nodes.n) != row)
        hubs = []
        for loop in (False, True):
            kin = sorted((s for s in spokes if s.loop is loop), key=lambda s: (s.determinant, s.node))
            hubs += kin[:1]
            for spoke in kin[1:]:
                self._join(kin[0], spoke)
        if len(hubs) == 2:
            self._join(hubs[0], hubs[1])

    def _join(self, a: "_Spoke", b: "_Spoke") -> None:
        """Adds an edge between the ends of two spokes, unless there is a more certain one of its kind."""
        if a.node == b.node:
            return
        a, b = (a, b) if a.node < b.node else (b, a)
        loop = a.loop or b.loop
        information = np.linalg.inv(transport_covariance(b.hub_from_node, a.backward) + b.covariance)
        i, j = self._edges["i"], self._edges["j"]
        same = ((i == a.node) & (j == b.node)) | ((i == b.node) & (j == a.node))
        same &= (self._edges["loop"] == loop) & self._edges["on"]
        if same.any():
            if np.linalg.det(self._edges["information"][same]).max() >= np.linalg.det(information):
                return
            self._edges.keep(~same)
        self.add_edge(
            a.node, b.node, a.hub_from_node.inverse() @ b.hub_from_node, (information + information.T) / 2, loop
        )

    def _row(self, node: int) -> int:
        names = self._nodes["node"]
        row = int(np.searchsorted(names, node))
        if row == len(names) or names[row] != node:
            raise KeyError(f"no node {node}")
        return row


@dataclass(frozen=True, slots=True)
class _Spoke:
    """An edge relative to the removed node (hub): a neighbour's pose, with covariance (3, 3) in its own frame."""

    node: int
    hub_from_node: Pose2
    covariance: Float64s
    loop: bool

    @classmethod
    def of(cls, edges: _Columns, k: int, hub: int) -> "_Spoke":
        i, j, i_from_j = int(edges["i"][k]), int(edges["j"][k]), pose_of(edges["relative"][k])
        covariance, loop = np.linalg.inv(edges["information"][k]), bool(edges["loop"][k])
        if i == hub:
            return cls(j, i_from_j, covariance, loop)
        return cls(i, i_from_j.inverse(), transport_covariance(i_from_j.inverse(), covariance), loop)

    @property
    def determinant(self) -> float:
        """Determinant of the covariance."""
        return float(np.linalg.det(self.covariance))

    @property
    def backward(self) -> Float64s:
        """Covariance (3, 3) of the hub's pose relative to the neighbour, in the hub's frame."""
        return transport_covariance(self.hub_from_node.inverse(), self.covariance)


EXACT_INFORMATION = 1e8 * np.eye(3)
"""Information of a known pose: a standard deviation of 0.1 mm and 0.1 mrad."""


def fixed_graph(graph: Graph) -> Graph:
    """Returns a graph of fixed nodes at the same poses, each with an exact edge from the first."""
    n = len(graph.nodes)
    loops = np.zeros(max(n - 1, 0), np.bool_)
    first, others = graph.nodes[:1], graph.nodes[1:]
    return Graph(
        nodes=graph.nodes,
        poses=graph.poses,
        fixed=np.ones(n, np.bool_),
        edges=np.arange(len(others)),
        i=np.repeat(first, len(others)),
        j=others.copy(),
        relative=relative_poses(graph.poses[:1], graph.poses[1:]),
        information=np.tile(EXACT_INFORMATION, (len(others), 1, 1)),
        loop=loops,
        on=~loops,
    )


def edge_chi2(graph: Graph, poses: Float64s) -> Float64s:
    """Returns the squared Mahalanobis distance (m,) of each edge's residual at poses (n, 3) in `map`."""
    i, j = graph.rows()
    residual = relative_poses(graph.relative, relative_poses(poses[i], poses[j]))
    return np.asarray(np.einsum("ka,kab,kb->k", residual, graph.information, residual))


def compose(a_from_b: Float64s, b_from_c: Float64s) -> Float64s:
    """Returns a_from_c (..., 3) of poses (..., 3) x, y, yaw: `Pose2.__matmul__` for arrays."""
    c, s = np.cos(a_from_b[..., 2]), np.sin(a_from_b[..., 2])
    x, y = b_from_c[..., 0], b_from_c[..., 1]
    rotate_matrix = (a_from_b[..., 0] + c * x - s * y, a_from_b[..., 1] + s * x + c * y)
    return np.stack((*rotate_matrix, wrapped_all(a_from_b[..., 2] + b_from_c[..., 2])), axis=-1)


def relative_poses(a_from_b: Float64s, a_from_c: Float64s) -> Float64s:
    """Returns b_from_c (..., 3) of poses a_from_b, a_from_c (..., 3) x, y, yaw."""
    c, s = np.cos(a_from_b[..., 2]), np.sin(a_from_b[..., 2])
    dx, dy = a_from_c[..., 0] - a_from_b[..., 0], a_from_c[..., 1] - a_from_b[..., 1]
    return np.stack((c * dx + s * dy, c * dy - s * dx, wrapped_all(a_from_c[..., 2] - a_from_b[..., 2])), axis=-1)


def transport_covariance(b_from_c: Pose2, covariance: Float64s) -> Float64s:
    """Returns the covariance (3, 3) at c, in its frame, from that at b, rigidly joined to c: by Ad(c_from_b)."""
    c, s = cos(b_from_c.yaw), sin(b_from_c.yaw)
    x, y = b_from_c.x, b_from_c.y
    adjoint = np.array(((c, s, s * x - c * y), (-s, c, c * x + s * y), (0.0, 0.0, 1.0)))
    return np.asarray(adjoint @ covariance @ adjoint.T)


def rotate_matrix(matrix: Float64s, yaw: float) -> Float64s:
    """Returns a covariance or information (3, 3) of (x, y, yaw), rotated by `yaw` rad: R(yaw) M R(yaw)'."""
    rotation = np.eye(3)
    rotation[:2, :2] = (Pose2(0, 0, yaw) @ np.eye(2)).T
    return np.asarray(rotation @ matrix @ rotation.T)


def pose_of(row: Float64s) -> Pose2:
    """Returns the pose of a row (3,) x, y, yaw."""
    return Pose2(float(row[0]), float(row[1]), float(row[2]))


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    view = array.view()
    view.flags.writeable = False
    return view


def _is_positive_definite(matrices: Float64s) -> Bools:
    """(k,) which matrices (k, 3, 3) are finite, symmetric and positive definite (Sylvester's criterion)."""
    finite: Bools = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    a = np.where(finite[:, None, None], matrices, 0.0)
    minor = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] ** 2
    positive = (a[:, 0, 0] > 0) & (minor > 0) & (np.linalg.det(a) > 0)
    return np.asarray(positive & (a == a.transpose(0, 2, 1)).all(axis=(1, 2)))


def _common_rows(a: Int64s, b: Int64s) -> tuple[Int64s, Int64s]:
    """Returns the rows in a and in b of the names that both hold."""
    _, in_a, in_b = np.intersect1d(a, b, assume_unique=True, return_indices=True)
    return in_a, in_b
