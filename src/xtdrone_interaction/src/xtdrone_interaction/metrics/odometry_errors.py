"""Errors of odometry against the truth: absolute and relative errors and drift of a trajectory.

Absolute trajectory error (ATE) and relative pose error (RPE) as J. Sturm et al. define them (A Benchmark for the
Evaluation of RGB-D SLAM Systems, IROS 2012), RPE over path lengths as in KITTI's benchmark (A. Geiger et al., Are we
ready for autonomous driving?, CVPR 2012), alignment after S. Umeyama (Least-squares estimation of transformation
parameters between two point patterns, PAMI 13, 1991) without scale.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from xtdrone_interaction.recording.recorded_flight import Recording
from xtdrone_interaction.recording.series_in_bounded_memory import Array, Series

ALIGNMENTS = ("first", "umeyama", "none")
_STEP = 10.0  # m of path over which relative errors are taken
_LEAST_POSES = 3
_LEAST_WAY = 1.0  # m; below it, drift per metre is meaningless, as for a vehicle that does not move


@dataclass(frozen=True)
class Trajectory:
    """Poses over time.

    Attributes:
        time: (t,) s, ascending.
        position: (t, 3) m.
        quaternion: (t, 4) body to reference, (w, x, y, z).
    """

    time: Array
    position: Array
    quaternion: Array

    def __len__(self) -> int:
        return len(self.time)

    @property
    def rotation(self) -> Rotation:
        """Body to reference."""
        return Rotation.from_quat(self.quaternion[:, [1, 2, 3, 0]])

    @property
    def way(self) -> Array:
        """Path length up to each pose, m, (t,)."""
        steps = np.linalg.norm(np.diff(self.position, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def at(self, time: Array) -> Trajectory:
        """Return the poses at other times, which must lie within the trajectory."""
        position = np.stack([np.interp(time, self.time, column) for column in self.position.T], axis=1)
        x, y, z, w = Slerp(self.time, self.rotation)(time).as_quat().T
        return Trajectory(time, position, np.stack([w, x, y, z], axis=1))

    def moved(self, turn: Rotation, shift: Array) -> Trajectory:
        """Return the poses in another reference frame: turned, then shifted by (3,) m."""
        x, y, z, w = (turn * self.rotation).as_quat().T
        return Trajectory(self.time, turn.apply(self.position) + shift, np.stack([w, x, y, z], axis=1))


@dataclass(frozen=True)
class OdometryErrors:
    """Errors of a trajectory.

    Attributes:
        alignment: one of ``ALIGNMENTS``.
        poses: number compared.
        way: length of the true path, m.
        ate: root mean square of the distances of equal times, m.
        greatest: of these, m.
        end: distance at the end, m.
        drift: the distance at the end over the path length, %; None for a path shorter than 1 m.
        rpe: root mean square of the error of relative positions over 10 m of path, m; None for a shorter path.
        rpe_percent: the same over the 10 m, %.
        rpe_turn: root mean square of the angle of relative rotations over 10 m, degrees.
    """

    alignment: str
    poses: int
    way: float
    ate: float
    greatest: float
    end: float
    drift: float | None
    rpe: float | None
    rpe_percent: float | None
    rpe_turn: float | None


def trajectory_of(series: Series) -> Trajectory:
    """Return the poses of a series x, y, z (m), quaternion x, y, z, w; invalid and repeated ones are left out."""
    length = np.linalg.norm(series.value[:, 3:7], axis=1)
    good = np.isfinite(series.value).all(axis=1) & (np.abs(length - 1.0) < 0.1)
    good[1:] &= np.diff(series.time) > 0.0
    value = series.value[good]
    return Trajectory(series.time[good], value[:, :3], value[:, [6, 3, 4, 5]])


def common(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Return both at the estimate's times within the truth."""
    if len(truth) < 2:
        return _part(estimate, np.zeros(len(estimate), bool)), truth
    both = (estimate.time >= truth.time[0]) & (estimate.time <= truth.time[-1])
    part = _part(estimate, both)
    return part, truth.at(part.time) if len(part) else truth


def _part(trajectory: Trajectory, chosen: Array) -> Trajectory:
    return Trajectory(trajectory.time[chosen], trajectory.position[chosen], trajectory.quaternion[chosen])


def umeyama(points: Array, targets: Array) -> tuple[Rotation, Array]:
    """Return the rotation and shift (3,) that bring points nearest to targets, both (n, 3), in the mean square."""
    middle, goal = points.mean(axis=0), targets.mean(axis=0)
    left, _, right = np.linalg.svd((targets - goal).T @ (points - middle))
    signs = np.diag([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    turn = Rotation.from_matrix(left @ signs @ right)
    return turn, goal - turn.apply(middle)


def aligned(estimate: Trajectory, truth: Trajectory, alignment: str) -> Trajectory:
    """Return an estimate in the truth's frame.

    Args:
        estimate, truth: poses at the same times, at least one.
        alignment: ``first``: the first poses' positions and headings agree; ``umeyama``: the positions do in the mean
            square; ``none``.

    Raises:
        ValueError: another alignment.
    """
    if alignment == "none":
        return estimate
    if alignment == "umeyama":
        return estimate.moved(*umeyama(estimate.position, truth.position))
    if alignment != "first":
        raise ValueError(f"alignment: {alignment!r} is not allowed, {', '.join(ALIGNMENTS)}")
    heading = (truth.rotation[0] * estimate.rotation[0].inv()).as_rotvec()[2]
    turn = Rotation.from_rotvec([0.0, 0.0, heading])
    return estimate.moved(turn, truth.position[0] - turn.apply(estimate.position[0]))


def errors(estimate: Trajectory, truth: Trajectory, alignment: str = "first") -> OdometryErrors | None:
    """Compare an estimate with the truth; None if they have less than three times in common.

    Args:
        estimate, truth: poses, each at its own times.
        alignment: one of ``ALIGNMENTS``.
    """
    found, true = common(estimate, truth)
    if len(found) < _LEAST_POSES:
        return None
    found = aligned(found, true, alignment)
    distance = np.linalg.norm(found.position - true.position, axis=1)
    way = float(true.way[-1])
    shift, turn = _relative_errors(found, true, _STEP)
    rpe = _rms(shift)
    return OdometryErrors(
        alignment,
        len(found),
        way,
        float(np.sqrt(np.mean(distance**2))),
        float(distance.max()),
        float(distance[-1]),
        100.0 * float(distance[-1]) / way if way >= _LEAST_WAY else None,
        rpe,
        None if rpe is None else 100.0 * rpe / _STEP,
        _rms(np.degrees(turn)),
    )


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _relative_errors(estimate: Trajectory, truth: Trajectory, step: float) -> tuple[Array, Array]:
    """Return the errors of relative poses over ``step`` m of the true path: distances (m) and angles (rad)."""
    way = truth.way
    last = np.searchsorted(way, way + step)
    first = np.flatnonzero(last < len(way))
    if not len(first):
        return np.empty(0), np.empty(0)
    last = last[first]
    turns, shifts = [], []
    for path in (estimate, truth):
        back = path.rotation[first].inv()
        turns.append(back * path.rotation[last])
        shifts.append(back.apply(path.position[last] - path.position[first]))
    difference = turns[1].inv() * turns[0]
    return np.linalg.norm(turns[1].inv().apply(shifts[0] - shifts[1]), axis=1), difference.magnitude()


def of_recording(recording: Recording) -> list[dict[str, Any]]:
    """Return the errors of all odometry of a recording beside the truth, as plain data with vehicle and source."""
    rows = []
    for vehicle, source, estimate, truth in pairs(recording):
        for alignment in ("first", "umeyama"):
            found = errors(estimate, truth, alignment)
            if found is not None:
                rows.append({"vehicle": vehicle, "source": source, **asdict(found)})
    return rows


def pairs(recording: Recording) -> list[tuple[str, str, Trajectory, Trajectory]]:
    """Return vehicle, source, odometry and truth of all odometry of a recording whose truth is known."""
    found = []
    for vehicle in recording.vehicles:
        truth = recording.true_poses.get(vehicle.name)
        if truth is None or not len(truth):
            continue
        for source, series in sorted(vehicle.odometry.items()):
            found.append((vehicle.name, source, trajectory_of(series), trajectory_of(truth)))
    return found


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write lines ``time x y z qx qy qz qw`` (s, m), the format of the TUM RGB-D benchmark."""
    order = trajectory.quaternion[:, [1, 2, 3, 0]]
    np.savetxt(path, np.column_stack([trajectory.time, trajectory.position, order]), fmt="%.9f")


def write_kitti(trajectory: Trajectory, path: Path) -> None:
    """Write lines of the first three rows of the 4 x 4 pose, the format of KITTI's odometry benchmark."""
    rows = np.concatenate([trajectory.rotation.as_matrix(), trajectory.position[:, :, None]], axis=2)
    np.savetxt(path, rows.reshape(len(rows), 12), fmt="%.9f")


def write_trajectories(recording: Recording, folder: Path) -> list[Path]:
    """Write odometry and truth at the same times for users of evo: VEHICLE_SOURCE.tum, .kitti and VEHICLE_truth..."""
    files: list[Path] = []
    for vehicle, source, estimate, truth in pairs(recording):
        found, true = common(estimate, truth)
        if len(found) < _LEAST_POSES:
            continue
        for name, trajectory in ((source, found), (f"{source}_truth", true)):
            for write, ending in ((write_tum, "tum"), (write_kitti, "kitti")):
                files.append(folder / f"{vehicle}_{name}.{ending}")
                write(trajectory, files[-1])
    return files
