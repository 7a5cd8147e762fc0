"""Loop closure: when the vehicle revisits a known place, the drift accumulated since then is estimated and removed.

Every few metres a keyframe stores the scan. A new one is registered, by generalised ICP on submaps, with one that is
close in space but far back along the path; a good match becomes an edge of the pose graph, in addition to those of
odometry.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import small_gicp
from numpy.typing import NDArray

from xtdrone_common.pose_matrices import inverse, transform_points
from xtdrone_common.settings import Settings, setting

from .pose_graph import Edge, optimise_graph

Array = NDArray[np.float64]

_NEIGHBOURS = 20
_COARSE = 3  # factor of the reach in the first of two registrations
_DRIFT_TURN = 0.2  # rotational per translational drift, rad/m


@dataclass(frozen=True)
class LoopOptions(Settings):
    """Private parameters of loop closure."""

    spacing: float = setting(3.0, low=0.2, high=100.0, unit="m", text="path length between two keyframes")
    radius: float = setting(
        12.0, low=1.0, high=200.0, unit="m", text="maximum distance between the two keyframes of a loop"
    )
    way: float = setting(
        40.0, low=1.0, high=1e5, unit="m", text="minimum path length between the two keyframes of a loop"
    )
    submap: int = setting(2, low=0, high=20, text="keyframes on each side that form the submap of a known place")
    resolution: float = setting(0.5, low=0.05, high=5.0, unit="m", text="cell size for downsampling")
    reach: float = setting(1.5, low=0.1, high=20.0, unit="m", text="maximum distance of corresponding points")
    least_share: float = setting(0.6, low=0.0, high=1.0, text="minimum fraction of points with a correspondence")
    most_residual: float = setting(2.0, above=0.0, high=100.0, text="maximum RMS of normalised residuals")
    drift: float = setting(0.005, above=0.0, high=1.0, text="drift of odometry, m per m travelled")
    loop_noise: float = setting(0.05, above=0.0, high=10.0, unit="m", text="standard deviation of a loop's position")


@dataclass
class Keyframe:
    """A keyframe.

    Attributes:
        odometry: (4, 4) its pose by odometry.
        points: (n, 3) m, its scan, in the body's frame.
        way: path length from the start, m.
    """

    odometry: Array
    points: Array
    way: float


@dataclass
class LoopClosure:
    """Keyframes, loops and the corrected poses.

    Attributes:
        options: Options of the loop closure.
        keyframes: Keyframes in order.
        poses: (4, 4) corrected pose of each keyframe, in map.
        edges: Edges of odometry and loops.
    """

    options: LoopOptions
    keyframes: list[Keyframe] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)

    @property
    def correction(self) -> Array:
        """Pose (4, 4) of odom in map."""
        if not self.keyframes:
            return np.eye(4)
        found: Array = self.poses[-1] @ inverse(self.keyframes[-1].odometry)
        return found

    @property
    def loops(self) -> list[Edge]:
        """The edges of closed loops."""
        return [edge for edge in self.edges if edge.robust]

    def is_due(self, odometry: Array) -> bool:
        """Return whether the vehicle has moved far enough since the last keyframe."""
        return not self.keyframes or self._step(odometry) >= self.options.spacing

    def add(self, odometry: Array, points: Array) -> bool:
        """Add a keyframe and return whether it closed a loop.

        Args:
            odometry: (4, 4) pose by odometry.
            points: (n, 3) m, the deskewed scan, in the body's frame.
        """
        if not self.keyframes:
            self.keyframes.append(Keyframe(odometry, _thin(points, self.options.resolution), 0.0))
            self.poses.append(odometry)
            return False
        last, pose = self.keyframes[-1], self.correction @ odometry
        step = self._step(odometry)
        self.keyframes.append(Keyframe(odometry, _thin(points, self.options.resolution), last.way + step))
        self.poses.append(pose)
        number = len(self.keyframes) - 1
        self.edges.append(
            Edge(
                number - 1, number, inverse(last.odometry) @ odometry, _information(self.options.drift * max(step, 0.1))
            )
        )
        loop = self._loop(number)
        if loop is None:
            return False
        self.edges.append(loop)
        self.poses = optimise_graph(self.poses, self.edges)
        return True

    def correct(self, odometry: Array) -> Array:
        """Return the current pose (4, 4) in map for a pose by odometry."""
        found: Array = self.correction @ odometry
        return found

    def _step(self, odometry: Array) -> float:
        return float(np.linalg.norm(odometry[:3, 3] - self.keyframes[-1].odometry[:3, 3]))

    def _loop(self, number: int) -> Edge | None:
        """Return the loop of a new keyframe to the nearest known place, None if there is none."""
        here, way = self.poses[number][:3, 3], self.keyframes[number].way
        places = np.array([pose[:3, 3] for pose in self.poses[:number]])
        ways = np.array([frame.way for frame in self.keyframes[:number]])
        distance = np.linalg.norm(places - here, axis=1)
        distance[way - ways < self.options.way] = np.inf
        if not len(distance) or distance.min() > self.options.radius:
            return None
        known = int(distance.argmin())
        relative = self._register_pair(known, number)
        if relative is None:
            return None
        return Edge(known, number, relative, _information(self.options.loop_noise), robust=True)

    def _register_pair(self, known: int, number: int) -> Array | None:
        """Return the pose of a keyframe in a known one from their scans, or None if they do not match."""
        options = self.options
        guess = inverse(self.poses[known]) @ self.poses[number]
        target, tree = small_gicp.preprocess_points(self._submap(known), options.resolution, _NEIGHBOURS, 1)
        source, _ = small_gicp.preprocess_points(self.keyframes[number].points, options.resolution, _NEIGHBOURS, 1)
        for reach in (_COARSE * options.reach, options.reach):
            result = small_gicp.align(
                target, source, tree, guess, max_correspondence_distance=reach, num_threads=1, max_iterations=40
            )
            guess = np.asarray(result.T_target_source)
        inliers = max(int(result.num_inliers), 1)
        fits = inliers / source.size() >= options.least_share
        fits &= np.sqrt(2.0 * result.error / inliers) <= options.most_residual
        return guess if result.converged and fits else None

    def _submap(self, known: int) -> Array:
        """Return the points around a keyframe, in its frame."""
        first, last = max(0, known - self.options.submap), known + self.options.submap + 1
        back = inverse(self.poses[known])
        parts = zip(self.poses[first:last], self.keyframes[first:last], strict=True)
        return np.concatenate([transform_points(back @ pose, frame.points) for pose, frame in parts])


def _thin(points: Array, cell: float) -> Array:
    return np.asarray(small_gicp.voxelgrid_sampling(points, 0.5 * cell).points())[:, :3]


def _information(error: float) -> Array:
    turn = _DRIFT_TURN * error
    return np.diag([error**-2.0] * 3 + [turn**-2.0] * 3)
