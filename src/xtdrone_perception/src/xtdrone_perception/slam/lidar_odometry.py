"""Lidar odometry: each scan is registered to the map built from the previous ones.

The registration is voxelised generalised ICP (K. Koide et al., Voxelized GICP for fast and accurate 3D point cloud
registration, ICRA 2021) by small_gicp, against a map of Gaussians from which voxels not seen for a long time are
removed. A point corresponds to the voxel that contains it, so a surface close to a voxel boundary is missed if the
prediction is slightly off: a second map, whose voxels are shifted by half their size, has it near a voxel's centre.
Point-to-point ICP was measured for comparison: the few rings on the ground move along with the lidar, so it lost 1 m of
height over 80 m (this method: 0.1 m), and took several times as long.

Registration uses one thread: sums over several threads would depend on their order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from xtdrone_common.clouds import PointScan
from xtdrone_common.pose_matrices import pose_of
from xtdrone_common.settings import Settings, setting

from .deskewing import ScanMotion, deskew
from .odometry_health import Estimate, weakest_share, without_registration

Array = NDArray[np.float64]

_ITERATIONS = 20
_ROTATION_STEP, _TRANSLATION_STEP = 1e-4, 1e-4  # rad and m: smaller steps end the iteration
_CLEAR_CYCLE = 50  # scans between two removals of old voxels
_CORRELATION = 50.0
"""Factor by which the covariance exceeds that of independent points: points on one surface share its errors.

Calibrated on ten flights of 244 m (cities 1 to 10, seeds 0 to 9): with it the mean square of a pose's errors in the
map's frame, normalised by the covariance, is 0.94 per degree of freedom, 0.63 to 1.47 per flight.
"""


@dataclass(frozen=True)
class RegistrationOptions(Settings):
    """Private parameters of the registration."""

    range_min: float = setting(0.5, low=0.0, high=100.0, unit="m", text="closer points are ignored")
    range_max: float = setting(100.0, low=1.0, high=1000.0, unit="m", text="farther points are ignored")
    spacing: float = setting(0.8, low=0.05, high=5.0, unit="m", text="cell size for downsampling a scan")
    voxel: float = setting(1.0, low=0.1, high=10.0, unit="m", text="voxel size of the map")
    neighbours: int = setting(20, low=5, high=100, text="number of points used to estimate the surface around a point")
    reach: float = setting(1.0, low=0.1, high=10.0, unit="m", text="maximum distance of corresponding points")
    memory: int = setting(
        3000, low=10, high=1_000_000, text="scans after which voxels not seen are removed from the map"
    )
    least_points: int = setting(100, low=10, high=100_000, text="minimum number of points of a scan that is registered")


@dataclass(frozen=True, kw_only=True)
class Registration(Estimate):
    """Result of one scan, at its end; the residual is about 0.5 with 2 cm of noise.

    Attributes:
        points: (n, 3) of the deskewed scan, in the body's frame at its end.
        surfaces: the scan prepared for the map; None: too few points.
    """

    points: Array
    surfaces: small_gicp.PointCloud | None = None


class _Map:
    """A map of Gaussians with shifted voxels.

    Attributes:
        gaussians: Gaussians in the shifted frame.
    """

    def __init__(self, settings: RegistrationOptions, shift: float) -> None:
        """Start empty; shift: m along each axis."""
        self.gaussians = small_gicp.GaussianVoxelMap(settings.voxel)
        self.gaussians.set_lru(settings.memory, _CLEAR_CYCLE)
        self._shift = np.full(3, shift)

    def align(self, source: small_gicp.PointCloud, pose: Array, reach: float) -> tuple[Array, Any]:
        """Return the pose (4, 4) of a scan, found from an initial one, and small_gicp's result."""
        result = small_gicp.align(
            self.gaussians,
            source,
            self._shift_pose(pose, 1.0),
            max_correspondence_distance=reach,
            num_threads=1,
            max_iterations=_ITERATIONS,
            rotation_epsilon=_ROTATION_STEP,
            translation_epsilon=_TRANSLATION_STEP,
        )
        return _orthonormal(self._shift_pose(np.asarray(result.T_target_source), -1.0)), result

    def insert(self, surfaces: small_gicp.PointCloud, pose: Array) -> None:
        """Add a scan."""
        self.gaussians.insert(surfaces, self._shift_pose(pose, 1.0))

    def _shift_pose(self, pose: Array, sign: float) -> Array:
        moved = pose.copy()
        moved[:3, 3] += sign * self._shift
        return moved


class LidarOdometry:
    """The map and the vehicle's pose in it.

    Attributes:
        pose: (4, 4) body to map, at the end of the last scan.
    """

    def __init__(self, settings: RegistrationOptions, lidar: Array, start: Array) -> None:
        """Start with an empty map.

        Args:
            settings: Settings of the registration.
            lidar: (4, 4) pose of the lidar in the body.
            start: (4, 4) pose of the body in the map.
        """
        self._settings = settings
        self._lidar = lidar
        self._maps = [_Map(settings, shift) for shift in (0.0, 0.5 * settings.voxel)]
        self.pose = start

    def points_of(self, scan: PointScan, motion: ScanMotion) -> Array:
        """Return the points within range, (n, 3) m, deskewed, in the body's frame at the end of the scan."""
        settings = self._settings
        ranges = np.linalg.norm(scan.points, axis=1)
        near = (ranges >= settings.range_min) & (ranges <= settings.range_max)
        body = scan.points[near] @ self._lidar[:3, :3].T + self._lidar[:3, 3]
        return deskew(body, scan.times[near], motion)

    def register(self, points: Array, predicted: Array) -> Registration:
        """Return the pose of a scan; the map and ``pose`` do not change.

        Args:
            points: (n, 3), see ``points_of``.
            predicted: (4, 4) pose of the body at the end of the scan.
        """
        settings = self._settings
        if len(points) < settings.least_points:
            return Registration(**without_registration(predicted, len(points), False), points=points)
        source = self._surfaces(points)
        count = source.size()
        if self._maps[0].gaussians.size() == 0:
            return Registration(**without_registration(predicted, count, True), points=points, surfaces=source)
        pose = predicted
        for part in self._maps:
            pose, result = part.align(source, pose, settings.reach)
        inliers = max(int(result.num_inliers), 1)
        square = 2.0 * float(result.error) / inliers
        information = np.asarray(result.H)
        return Registration(
            pose=pose,
            predicted=predicted,
            count=count,
            share=result.num_inliers / count,
            residual=float(np.sqrt(square)),
            weakest=weakest_share(information[3:, 3:]),
            covariance=_covariance(information, square, pose),
            points=points,
            surfaces=source,
        )

    def accept(self, registration: Registration) -> None:
        """Move to the pose of a scan and add its points to the map."""
        self.pose = registration.pose
        if registration.surfaces is not None:
            for part in self._maps:
                part.insert(registration.surfaces, registration.pose)

    def move(self, pose: Array) -> None:
        """Move to a predicted pose, without registration."""
        self.pose = pose

    def local_map(self, radius: float) -> Array:
        """Return the centres of the map's voxels within a radius (m) of the vehicle, (n, 3) m, map."""
        gaussians = self._maps[0].gaussians
        if gaussians.size() == 0:
            return np.empty((0, 3))
        points = np.asarray(gaussians.voxel_points())[:, :3]
        near = np.linalg.norm(points - self.pose[:3, 3], axis=1) <= radius
        found: Array = points[near]
        return found

    def _surfaces(self, points: Array) -> small_gicp.PointCloud:
        """Return a downsampled scan with the surfaces around its points."""
        source = small_gicp.voxelgrid_sampling(points, self._settings.spacing)
        small_gicp.estimate_covariances(source, None, self._settings.neighbours)
        return source


def _orthonormal(pose: Array) -> Array:
    """Return a pose with an orthonormal rotation, so that rounding errors do not accumulate."""
    return pose_of(pose[:3, 3], Rotation.from_matrix(pose[:3, :3]))


def _covariance(information: Array, square: float, pose: Array) -> Array:
    """Return the covariance of a registration, order x, y, z, rotation.

    Args:
        information: (6, 6) Hessian of small_gicp: rotation, then translation, both in the body's axes.
        square: mean square of the normalised residuals.
        pose: (4, 4).
    """
    found = np.linalg.pinv(information, hermitian=True) * max(square, 1e-4) * _CORRELATION
    order = [3, 4, 5, 0, 1, 2]
    found = found[np.ix_(order, order)]
    turn = np.eye(6)
    turn[:3, :3] = pose[:3, :3]
    covariance: Array = turn @ found @ turn.T
    return 0.5 * (covariance + covariance.T)
