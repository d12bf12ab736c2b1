# SPDX-License-Identifier: Apache-2.0
"""Where all keyframes are, by all that was measured between them: graph-based SLAM (Grisetti et al., 2010).

An edge is the pose of one node in another's frame with its information. Its residual is the (x, y, yaw) of
measured^-1 @ (i_from_map @ map_from_j), in the frame of j; chi2 is its squared Mahalanobis length. (gtsam 4.3 takes the
logarithm of that: the same to first order.)
"""

from dataclasses import dataclass, fields
from math import cos, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.geometry import Bools, Float64s, Pose2, wrapped_all

Int64s = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Graph:
    """A pose graph as it was: read-only arrays, ready for a Job or a file. n nodes, m edges.

    nodes: (n,) int64, their names, rising.  poses: (n, 3) x, y, yaw in `map`.  fixed: (n,) bool, never moved.
    edges: (m,) int64, their names, rising.  i, j: (m,) int64, names of nodes.  relative: (m, 3) i_from_j.
    information: (m, 3, 3) of (x, y, yaw) in the frame of j.  loop: (m,) bool, a closure: it may be wrong.
    on: (m,) bool, False where it was found wrong.
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
        """ValueError says which array is not what it must be: a graph may come from a damaged file."""
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
        if not _definite(self.information).all():
            raise ValueError("an edge's information is not symmetric and positive definite")

    def before(self, node: int) -> "Graph":
        """The part of it whose nodes have names under `node`, and the edges between them."""
        n, within = int(np.searchsorted(self.nodes, node)), (self.i < node) & (self.j < node)
        return Graph(
            self.nodes[:n].copy(), self.poses[:n].copy(), self.fixed[:n].copy(),
            *(getattr(self, f.name)[within] for f in fields(self)[3:]),
        )  # fmt: skip

    def rows(self) -> tuple[Int64s, Int64s]:
        """Where `nodes` holds each edge's i and j: two (m,)."""
        return np.searchsorted(self.nodes, self.i), np.searchsorted(self.nodes, self.j)


@dataclass(frozen=True, slots=True)
class Optimised:
    """What an optimisation found, for the nodes and edges of its snapshot.

    poses: (n, 3).  weights: (m,) 0 to 1, how far an edge was believed; 0 is off, odometry's is 1.  chi2: (m,) of each
    edge at the end, also of those that are off.  before, after: sums of chi2 over the edges that are on at the end.
    moved: map_from_map of the last node, which nodes that were added meanwhile take too.
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
        """(m,) which edges are believed."""
        return self.weights > 0


class _Columns:
    """Arrays of one length that grow together, by doubling. The first, `key`, rises."""

    def __init__(self, **columns: NDArray[Any]) -> None:
        self.arrays = {name: array.copy() for name, array in columns.items()}
        self.n = len(next(iter(columns.values())))

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.arrays[name][: self.n]

    def append(self, **row: Any) -> None:
        for name, array in self.arrays.items():
            if self.n == len(array):
                array = self.arrays[name] = np.concatenate(
                    (array, np.zeros((max(64, len(array)), *array.shape[1:]), array.dtype))
                )
            array[self.n] = row[name]
        self.n += 1

    def keep(self, kept: Bools) -> None:
        n = int(kept.sum())
        for array in self.arrays.values():
            array[:n] = array[: self.n][kept]
        self.n = n


class PoseGraph:
    """Keyframes and what was measured between them. The first node is held: it is where `map` is.

    A node is named by the number that `add` returned. Names rise and are never given again, so a caller may keep what
    belongs to a node under its name, and what a Job found for an older snapshot still finds its place.
    """

    def __init__(self) -> None:
        no, none = np.zeros(0, np.int64), np.zeros(0, np.bool_)
        zeros = np.zeros((0, 3))
        self._set(
            Graph(no, zeros, none, no.copy(), no.copy(), no.copy(), zeros.copy(), np.zeros((0, 3, 3)), none, none)
        )

    @classmethod
    def of(cls, graph: Graph) -> "PoseGraph":
        """Goes on with a snapshot, such as a saved one. ValueError where it is damaged."""
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
        """(n,) names, in the order in which they were added. Read-only, and old after the next change."""
        return _read_only(self._nodes["node"])

    @property
    def poses(self) -> Float64s:
        """(n, 3) x, y, yaw in `map`, in the order of `nodes`. Read-only, and old after the next change."""
        return _read_only(self._nodes["pose"])

    @property
    def n_edges(self) -> int:
        return self._edges.n

    def pose(self, node: int) -> Pose2:
        """map_from_base of a node."""
        return pose_of(self._nodes["pose"][self._row(node)])

    def leave_names(self, until: int) -> None:
        """The next node's name is this at least."""
        self._next_node = max(self._next_node, until)

    def add(self, map_from_base: Pose2, fixed: bool = False) -> int:
        """A new node's name."""
        name = self._next_node
        self._nodes.append(
            node=name, pose=(map_from_base.x, map_from_base.y, map_from_base.yaw), fixed=fixed or self._nodes.n == 0
        )
        self._next_node += 1
        return name

    def connect(self, i: int, j: int, i_from_j: Pose2, information: Float64s, loop: bool) -> None:
        """A measurement between two nodes, with information (3, 3) of (x, y, yaw) in the frame of j.

        loop: it may be wrong altogether; what is no loop (odometry, scan to scan) is always believed.
        """
        if i == j or not _definite(np.asarray(information)[None]).all():
            raise ValueError(f"an edge from {i} to {j} with information {np.asarray(information).tolist()}")
        self._row(i), self._row(j)
        self._edges.append(
            edge=self._next_edge, i=i, j=j, relative=(i_from_j.x, i_from_j.y, i_from_j.yaw),
            information=information, loop=loop, on=True,
        )  # fmt: skip
        self._next_edge += 1

    def disconnect(self, i: int, j: int) -> None:
        """Drops all edges from node i to node j."""
        self._edges.keep(~((self._edges["i"] == i) & (self._edges["j"] == j)))

    def move(self, first: int, motion: Pose2) -> None:
        """Moves the nodes from the name `first` on, as one: `motion` @ pose."""
        rows = (self._nodes["node"] >= first) & ~self._nodes["fixed"]
        poses = self._nodes["pose"]
        poses[rows] = composed(np.array((motion.x, motion.y, motion.yaw)), poses[rows])

    def snapshot(self) -> Graph:
        """All of it as it is now."""
        return Graph(
            self._nodes["node"].copy(), self._nodes["pose"].copy(), self._nodes["fixed"].copy(),
            *(self._edges[name].copy() for name in ("edge", "i", "j", "relative", "information", "loop", "on")),
        )  # fmt: skip

    def take(self, result: Optimised) -> None:
        """Takes what an optimisation of an older snapshot found. Newer nodes move with the snapshot's last one."""
        names, poses, fixed = self._nodes["node"], self._nodes["pose"], self._nodes["fixed"]
        mine, theirs = _common(names, result.nodes)
        poses[mine] = result.poses[theirs]
        if len(result.nodes):
            newer = (names > result.nodes[-1]) & ~fixed
            poses[newer] = composed(np.array((result.moved.x, result.moved.y, result.moved.yaw)), poses[newer])
        mine, theirs = _common(self._edges["edge"], result.edges)
        self._edges["on"][mine] = result.on[theirs]

    def remove(self, node: int) -> None:
        """Takes a node out, and joins its neighbours by what it knew about them.

        Exact to first order between two neighbours (the Schur complement of a chain). The clique that more of them
        would leave is thinned to a tree of its most certain edges, in the manner of Kretzschmar & Stachniss (2012):
        odometry's neighbours are joined by odometry, the others to their most certain one. Of two edges between the
        same two nodes the more certain one stays; they are not added: they saw the same walls. So what is driven again
        and again leaves no more edges than there are pairs of near nodes. Closures that are off are dropped.
        """
        row = self._row(node)
        if self._nodes["fixed"][row]:
            raise ValueError(f"node {node} is fixed: it holds the others in `map`")
        i, j, on = self._edges["i"], self._edges["j"], self._edges["on"]
        touching = (i == node) | (j == node)
        spokes = [_Spoke.of(self._edges, int(k), node) for k in np.flatnonzero(touching & on)]
        self._edges.keep(~touching)
        kept = np.ones(self._nodes.n, np.bool_)
        kept[row] = False
        self._nodes.keep(kept)
        hubs = []
        for loop in (False, True):
            kin = sorted((s for s in spokes if s.loop is loop), key=lambda s: (s.doubt, s.node))
            hubs += kin[:1]
            for spoke in kin[1:]:
                self._join(kin[0], spoke)
        if len(hubs) == 2:
            self._join(hubs[0], hubs[1])

    def _join(self, a: "_Spoke", b: "_Spoke") -> None:
        """An edge between the ends of two spokes, unless there is a more certain one of its kind."""
        if a.node == b.node:
            return
        a, b = (a, b) if a.node < b.node else (b, a)
        loop = a.loop or b.loop
        information = np.linalg.inv(carried(b.hub_from_node, a.backward) + b.covariance)
        i, j = self._edges["i"], self._edges["j"]
        same = ((i == a.node) & (j == b.node)) | ((i == b.node) & (j == a.node))
        same &= (self._edges["loop"] == loop) & self._edges["on"]
        if same.any():
            if np.linalg.det(self._edges["information"][same]).max() >= np.linalg.det(information):
                return
            self._edges.keep(~same)
        self.connect(
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
    """An edge seen from the node that is removed: the neighbour's pose, with covariance (3, 3) in its own frame."""

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
        return cls(i, i_from_j.inverse(), carried(i_from_j.inverse(), covariance), loop)

    @property
    def doubt(self) -> float:
        return float(np.linalg.det(self.covariance))

    @property
    def backward(self) -> Float64s:
        """The covariance of the removed node's pose seen from the neighbour, in the removed node's frame."""
        return carried(self.hub_from_node.inverse(), self.covariance)


EXACT = 1e8 * np.eye(3)


def still(graph: Graph) -> Graph:
    """A graph whose nodes stay where they are, each known exactly from the first."""
    n = len(graph.nodes)
    loops = np.zeros(max(n - 1, 0), np.bool_)
    first, others = graph.nodes[:1], graph.nodes[1:]
    return Graph(
        graph.nodes, graph.poses, np.ones(n, np.bool_), np.arange(len(others)), np.repeat(first, len(others)),
        others.copy(), between(graph.poses[:1], graph.poses[1:]), np.tile(EXACT, (len(others), 1, 1)), loops, ~loops,
    )  # fmt: skip


def edge_chi2(graph: Graph, poses: Float64s) -> Float64s:
    """Squared Mahalanobis distance (m,) of each edge's residual at poses (n, 3)."""
    i, j = graph.rows()
    residual = between(graph.relative, between(poses[i], poses[j]))
    chi2: Float64s = np.einsum("ka,kab,kb->k", residual, graph.information, residual)
    return chi2


def composed(a_from_b: Float64s, b_from_c: Float64s) -> Float64s:
    """a_from_c (..., 3) of poses (..., 3) x, y, yaw: `Pose2`'s @ for arrays."""
    c, s = np.cos(a_from_b[..., 2]), np.sin(a_from_b[..., 2])
    x, y = b_from_c[..., 0], b_from_c[..., 1]
    turned = (a_from_b[..., 0] + c * x - s * y, a_from_b[..., 1] + s * x + c * y)
    return np.stack((*turned, wrapped_all(a_from_b[..., 2] + b_from_c[..., 2])), axis=-1)


def between(a_from_b: Float64s, a_from_c: Float64s) -> Float64s:
    """b_from_c (..., 3) of poses (..., 3)."""
    c, s = np.cos(a_from_b[..., 2]), np.sin(a_from_b[..., 2])
    dx, dy = a_from_c[..., 0] - a_from_b[..., 0], a_from_c[..., 1] - a_from_b[..., 1]
    return np.stack((c * dx + s * dy, c * dy - s * dx, wrapped_all(a_from_c[..., 2] - a_from_b[..., 2])), axis=-1)


def carried(b_from_c: Pose2, covariance: Float64s) -> Float64s:
    """A covariance (3, 3) of b, in b's frame, as it is at c that is rigidly joined to b: by Ad(c_from_b)."""
    c, s = cos(b_from_c.yaw), sin(b_from_c.yaw)
    x, y = b_from_c.x, b_from_c.y
    adjoint = np.array(((c, s, s * x - c * y), (-s, c, c * x + s * y), (0.0, 0.0, 1.0)))
    return np.asarray(adjoint @ covariance @ adjoint.T)


def turned(matrix: Float64s, yaw: float) -> Float64s:
    """A covariance or an information (3, 3) of (x, y, yaw), in axes turned by -yaw."""
    rotation = np.eye(3)
    rotation[:2, :2] = (Pose2(0, 0, yaw) @ np.eye(2)).T
    return np.asarray(rotation @ matrix @ rotation.T)


def pose_of(row: Float64s) -> Pose2:
    """A row (3,) of poses."""
    return Pose2(float(row[0]), float(row[1]), float(row[2]))


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    view = array.view()
    view.flags.writeable = False
    return view


def _definite(matrices: Float64s) -> Bools:
    """Which of the matrices (k, 3, 3) are finite, symmetric and positive definite (Sylvester's criterion)."""
    finite: Bools = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    a = np.where(finite[:, None, None], matrices, 0.0)
    minor = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] ** 2
    positive = (a[:, 0, 0] > 0) & (minor > 0) & (np.linalg.det(a) > 0)
    return np.asarray(positive & (a == a.transpose(0, 2, 1)).all(axis=(1, 2)))


def _common(a: Int64s, b: Int64s) -> tuple[Int64s, Int64s]:
    """Where the names that both have stand in either."""
    _, in_a, in_b = np.intersect1d(a, b, assume_unique=True, return_indices=True)
    return in_a, in_b
