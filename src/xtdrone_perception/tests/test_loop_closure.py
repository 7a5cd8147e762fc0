"""Pose graph and loop closure."""

from __future__ import annotations

import numpy as np
import pytest
from room_scans import directions, ranges
from scipy.spatial.transform import Rotation

from xtdrone_common.pose_matrices import inverse, pose_of, pose_of_vector
from xtdrone_perception.slam.loops.loop_closure import LoopClosure, LoopOptions
from xtdrone_perception.slam.loops.pose_graph import Edge, optimise_graph

RNG = np.random.default_rng(0)
FINE = np.diag([1e4] * 3 + [1e5] * 3)


def ring(count: int = 20, radius: float = 10.0) -> list[np.ndarray]:
    """Return poses on a circle, facing along it; the last equals the first."""
    angles = np.linspace(0.0, 2.0 * np.pi, count + 1)
    return [
        pose_of(
            (radius * np.cos(a), radius * np.sin(a), 0.2 * np.sin(3 * a)), Rotation.from_rotvec([0, 0, a + np.pi / 2])
        )
        for a in angles
    ]


def chain(poses: list[np.ndarray]) -> list[Edge]:
    return [Edge(k, k + 1, inverse(poses[k]) @ poses[k + 1], FINE) for k in range(len(poses) - 1)]


def test_true_edges_are_met_exactly_from_a_bad_start() -> None:
    true = ring()
    edges = [*chain(true), Edge(0, 20, inverse(true[0]) @ true[20], FINE, robust=True)]
    start = [true[0]] + [pose @ pose_of_vector(0.2 * RNG.standard_normal(6)) for pose in true[1:]]
    for found, pose in zip(optimise_graph(start, edges), true, strict=True):
        assert found == pytest.approx(pose, abs=1e-6)


def test_a_wrong_loop_loses_its_weight() -> None:
    true = ring()
    wrong = Edge(3, 14, pose_of((0.0, 0.0, 0.0), Rotation.identity()), FINE, robust=True)
    edges = [*chain(true), Edge(0, 20, inverse(true[0]) @ true[20], FINE, robust=True), wrong]
    found = optimise_graph(true, edges)
    assert max(np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in zip(found, true, strict=True)) < 0.05
    pulled = optimise_graph(true, [*edges[:-1], Edge(3, 14, wrong.measured, FINE)])
    assert max(np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in zip(pulled, true, strict=True)) > 1.0


def test_edges_of_unknown_poses_are_named() -> None:
    with pytest.raises(ValueError, match="edge: 0 to 7 is not allowed, there are 3 poses"):
        optimise_graph(ring(2), [Edge(0, 7, np.eye(4), FINE)])


def test_a_lap_with_drift_is_corrected_to_less_than_half() -> None:
    """Odometry drifts by 2 % of the path in position and heading; the scans of the start are recognised after a lap."""
    true = [pose_of((5.0 * np.cos(a) - 3, 4.0 * np.sin(a), 2.0), Rotation.from_rotvec([0.0, 0.0, 0.3 * np.sin(a)]))
            for a in np.linspace(0.0, 2.0 * np.pi, 25)]  # fmt: skip
    drift = pose_of((0.02, 0.012, 0.006), Rotation.from_rotvec([0.0, 0.0, 0.004]))
    odometry = [true[0]]
    for k in range(1, len(true)):
        odometry.append(odometry[-1] @ inverse(true[k - 1]) @ true[k] @ drift)
    loops = LoopClosure(LoopOptions(spacing=1.0, way=15.0, radius=4.0, drift=0.02))
    rays = directions()
    for k, pose in enumerate(odometry):
        found = ranges(np.tile(true[k][:3, 3], (len(rays), 1)), rays @ true[k][:3, :3].T)
        points = rays * (found + 0.02 * np.random.default_rng(k).standard_normal(len(rays)))[:, None]
        assert loops.is_due(pose)
        loops.add(pose, points)
    assert loops.loops
    before = np.linalg.norm(odometry[-1][:3, 3] - true[-1][:3, 3])
    after = np.linalg.norm(loops.correct(odometry[-1])[:3, 3] - true[-1][:3, 3])
    assert before > 0.4
    assert after < 0.5 * before

    def rms(poses: list[np.ndarray]) -> float:
        return float(np.sqrt(np.mean([np.sum((a[:3, 3] - b[:3, 3]) ** 2) for a, b in zip(poses, true, strict=True)])))

    assert rms(loops.poses) < 0.5 * rms(odometry)
