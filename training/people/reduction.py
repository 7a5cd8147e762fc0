"""Make a triangle mesh coarser: half-edge collapses in order of their quadric error (Garland and Heckbert).

A collapse moves a vertex onto a neighbour, so that the remaining vertices are those of the fine mesh, with their shape
targets and skin weights.
"""

from __future__ import annotations

import heapq

import numpy as np


def reduce(vertices: np.ndarray, triangles: np.ndarray, count: int, importance: np.ndarray) -> np.ndarray:
    """Return at most ``count`` triangles (or as few as allowed) over some of the vertices.

    Args:
        vertices: (V, 3).
        triangles: (T, 3), each edge in at most two of them.
        count: requested number of triangles.
        importance: factor on each vertex's error, (V,).
    """
    return _Reduction(vertices, triangles, importance).run(count)


class _Reduction:
    def __init__(self, vertices: np.ndarray, triangles: np.ndarray, importance: np.ndarray) -> None:
        self._points = [tuple(p) for p in vertices.tolist()]
        self._faces: dict[int, tuple[int, int, int]] = {i: tuple(t) for i, t in enumerate(triangles.tolist())}
        self._around: list[set[int]] = [set() for _ in self._points]
        for i, face in self._faces.items():
            for vertex in face:
                self._around[vertex].add(i)
        self._quadrics = _quadrics(vertices, triangles, importance)
        self._version = [0] * len(self._points)
        self._heap: list[tuple[float, int, int, int, int]] = []

    def run(self, count: int) -> np.ndarray:
        for vertex, faces in enumerate(self._around):
            if faces:
                self._offer(vertex)
        while len(self._faces) > count and self._heap:
            _, u, v, version_u, version_v = heapq.heappop(self._heap)
            if self._version[u] == version_u and self._version[v] == version_v and self._allowed(u, v):
                self._collapse(u, v)
        return np.array([self._faces[i] for i in sorted(self._faces)])

    def _neighbours(self, vertex: int) -> set[int]:
        return {w for i in self._around[vertex] for w in self._faces[i]} - {vertex}

    def _offer(self, u: int) -> None:
        """Push all collapses of ``u`` onto its neighbours to the heap."""
        for v in self._neighbours(u):
            x, y, z = self._points[v]
            q = [a + b for a, b in zip(self._quadrics[u], self._quadrics[v], strict=True)]
            error = (
                q[0] * x * x + q[4] * y * y + q[7] * z * z + q[9]
                + 2.0 * (q[1] * x * y + q[2] * x * z + q[5] * y * z + q[3] * x + q[6] * y + q[8] * z)
            )  # fmt: skip
            near = sum((a - b) ** 2 for a, b in zip(self._points[u], self._points[v], strict=True))
            heapq.heappush(self._heap, (error + 1e-9 * near, u, v, self._version[u], self._version[v]))

    def _allowed(self, u: int, v: int) -> bool:
        """Return whether the collapse of u onto v keeps a valid surface and flips no triangle."""
        shared = self._around[u] & self._around[v]
        if not shared or len(self._neighbours(u) & self._neighbours(v)) != len(shared):
            return False
        if len(shared) == 2 and self._on_border(u):  # an inner edge between two borders, or off the border
            return False
        for i in self._around[u] - shared:
            before = _normal(*(self._points[w] for w in self._faces[i]))
            after = _normal(*(self._points[v if w == u else w] for w in self._faces[i]))
            dot = sum(a * b for a, b in zip(before, after, strict=True))
            sizes = sum(a * a for a in before) * sum(a * a for a in after)
            if dot <= 0.0 or dot * dot < 0.04 * sizes:
                return False
        return True

    def _on_border(self, u: int) -> bool:
        return len(self._neighbours(u)) != len(self._around[u])

    def _collapse(self, u: int, v: int) -> None:
        for i in list(self._around[u]):
            face = self._faces[i]
            if v in face:
                for w in face:
                    self._around[w].discard(i)
                del self._faces[i]
            else:
                self._faces[i] = tuple(v if w == u else w for w in face)  # type: ignore[assignment]
                self._around[v].add(i)
        self._around[u] = set()
        self._version[u] += 1
        self._quadrics[v] = [a + b for a, b in zip(self._quadrics[u], self._quadrics[v], strict=True)]
        for w in (v, *self._neighbours(v)):
            self._version[w] += 1
        for w in (v, *self._neighbours(v)):
            self._offer(w)


def _normal(a: tuple, b: tuple, c: tuple) -> tuple[float, float, float]:
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)


def _quadrics(vertices: np.ndarray, triangles: np.ndarray, importance: np.ndarray) -> list[list[float]]:
    """Return the ten numbers of each vertex's quadric: planes of its triangles, and walls along borders."""
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sizes = np.linalg.norm(normals, axis=1)
    units = normals / np.maximum(sizes, 1e-12)[:, None]
    out = np.zeros((len(vertices), 10))
    _add(out, triangles, units, corners[:, 0], sizes)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    owners = np.tile(np.arange(len(triangles)), 3)
    _, first, counts = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    border = first[counts == 1]
    along = vertices[edges[border, 1]] - vertices[edges[border, 0]]
    walls = np.cross(along, units[owners[border]])
    lengths = np.linalg.norm(walls, axis=1)
    walls /= np.maximum(lengths, 1e-12)[:, None]
    _add(out, edges[border], walls, vertices[edges[border, 0]], 10.0 * lengths**2)
    return (out * importance[:, None]).tolist()


def _add(out: np.ndarray, owners: np.ndarray, units: np.ndarray, points: np.ndarray, sizes: np.ndarray) -> None:
    planes = np.concatenate([units, -np.sum(units * points, axis=1, keepdims=True)], axis=1)
    products = (planes[:, :, None] * planes[:, None, :])[:, *np.triu_indices(4)] * sizes[:, None]
    for column in range(owners.shape[1]):
        np.add.at(out, owners[:, column], products)
