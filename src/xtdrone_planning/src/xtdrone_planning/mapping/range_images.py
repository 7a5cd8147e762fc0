"""Range images: the common form of lidar scans and depth images, each range with its direction and time.

A lidar cloud contains only returns. Where a whole neighbourhood of rays has none, space is free up to the sensor's
range; a single missing return may be a dropout and carries no information.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.clouds import ScanError
from xtdrone_common.settings import Settings, setting
from xtdrone_planning.mapping.range_image_kernels import fill_image, take_rays

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LidarMapping(Settings):
    """The lidar whose cloud is mapped; the defaults are those of ``iris_3d_lidar``."""

    lidar_topic: str = setting("velodyne_points", text="topic of the cloud below /VEHICLE/")
    lidar_position: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.06), low=-5.0, high=5.0, unit="m", text="position of the lidar in base_link, FLU"
    )
    columns: int = setting(512, low=16, high=4096, text="columns per revolution")
    channels: int = setting(32, low=1, high=256, text="planes")
    vertical_min: float = setting(-0.2617993877991494, low=-1.57, high=1.57, unit="rad", text="lowest plane")
    vertical_max: float = setting(0.2617993877991494, low=-1.57, high=1.57, unit="rad", text="highest plane")
    lidar_range: tuple[float, float] = setting(
        (0.3, 30.0), low=0.0, high=300.0, unit="m", text="minimum and maximum range of returns that are mapped"
    )


@dataclass(frozen=True)
class DepthMapping(Settings):
    """The depth camera whose image is mapped; the defaults are those of ``iris_depth_camera``."""

    depth_topic: str = setting("depth_camera/depth", text="namespace of image_raw and camera_info, below /VEHICLE/")
    depth_position: tuple[float, float, float] = setting(
        (0.1, 0.0, 0.0), low=-5.0, high=5.0, unit="m", text="position of the forward camera in base_link, FLU"
    )
    stride: int = setting(4, low=1, high=32, text="map every Nth pixel, horizontally and vertically", unit="px")
    depth_range: tuple[float, float] = setting(
        (0.2, 9.5), low=0.0, high=100.0, unit="m", text="minimum and maximum depth that is mapped"
    )


@dataclass(frozen=True)
class RangeImage:
    """The rays of one measurement in the sensor's frame (x ahead, y left, z up).

    Attributes:
        ranges: (rows, columns) m; NaN without a return.
        directions: (rows, columns, 3) unit vectors.
        times: (rows, columns) s after the stamp.
        farthest: range up to which space is free along rays without a return, m.
        round: whether the last column is adjacent to the first.
        ordered: whether neighbouring pixels are neighbouring directions; otherwise a missing return carries no
        information.
    """

    ranges: Array
    directions: Array
    times: Array
    farthest: float
    round: bool = False
    ordered: bool = True

    def rays(self, *, by_columns: bool = False) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Return the rays that tell something.

        Args:
            by_columns: Whether the rays are in the order of columns, not of rows.

        Returns:
            Ranges (n,), directions (n, 3), times (n,), and whether each ends at a surface (n,).
        """
        size = self.ranges.size
        ranges, directions, times = np.empty(size), np.empty((size, 3)), np.empty(size)
        hits = np.empty(size, np.bool_)
        count = take_rays(
            self.ranges, self.directions, self.times, self.farthest, self.round, self.ordered, by_columns,
            ranges, directions, times, hits,
        )  # fmt: skip
        return ranges[:count], directions[:count], times[:count], hits[:count]


class LidarImages:
    """Converts clouds of a spinning lidar to range images."""

    def __init__(self, settings: LidarMapping) -> None:
        """Prepare the directions of all rays."""
        self._settings = settings
        azimuth = np.linspace(-math.pi, math.pi, settings.columns, endpoint=False)
        elevation = np.linspace(settings.vertical_min, settings.vertical_max, settings.channels)[:, None]
        shape = (settings.channels, settings.columns)
        parts = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        self._directions = np.stack([np.broadcast_to(part, shape) for part in parts], axis=-1)

    def image(self, points: NDArray[np.void]) -> RangeImage:
        """Return the range image of a cloud.

        Args:
            points: Records of ``clouds.points_of``; without ``ring`` the order of points is unknown; without ``time``
                all points have the time of the stamp.
        """
        settings = self._settings
        x, y, z = (points[name].astype(float) for name in "xyz")
        names = points.dtype.names or ()
        times = points["time"].astype(float) if "time" in names else np.zeros(len(points))
        if "ring" not in names:
            return self._unordered(np.stack([x, y, z], axis=1), times)
        shape = settings.columns, settings.channels
        image, all_times = np.empty(shape).T, np.empty(shape).T  # in memory column by column, as a lidar turns
        directions = np.empty((*shape, 3)).transpose(1, 0, 2)
        rings = points["ring"].astype(np.int64)
        fill_image(x, y, z, times, rings, settings.lidar_range, self._directions, image, directions, all_times)
        return RangeImage(image, directions, all_times, settings.lidar_range[1], round=True)

    def _unordered(self, places: Array, times: Array) -> RangeImage:
        nearest, farthest = self._settings.lidar_range
        ranges = np.sqrt((places * places).sum(axis=1))
        used = np.isfinite(ranges) & (ranges >= nearest) & (ranges <= farthest) & np.isfinite(times)
        directions = places[used] / ranges[used, None]
        return RangeImage(ranges[None, used], directions[None], times[None, used], farthest, ordered=False)


class DepthImages:
    """Converts images of a depth camera to range images."""

    def __init__(self, settings: DepthMapping) -> None:
        """Start without the camera's intrinsics."""
        self._settings = settings
        self._key: tuple[float, ...] = ()
        self._directions = np.zeros((0, 0, 3))
        self._lengths = np.zeros((0, 0))

    def image(self, depths: Array, intrinsics: tuple[float, float, float, float]) -> RangeImage:
        """Return the range image of a depth image.

        Args:
            depths: (height, width) m along the optical axis, NaN or infinite without a value.
            intrinsics: fx, fy, cx, cy, pixels, of camera_info's K.

        Raises:
            ScanError: a focal length is not positive.
        """
        step = self._settings.stride
        self._prepare(depths.shape, intrinsics)
        nearest, farthest = self._settings.depth_range
        thinned = np.asarray(depths[step // 2 :: step, step // 2 :: step], float)
        used = (thinned >= nearest) & (thinned <= farthest)
        ranges = np.where(used, thinned, np.nan) * self._lengths
        return RangeImage(ranges, self._directions, np.zeros_like(ranges), farthest)

    def _prepare(self, shape: tuple[int, ...], intrinsics: tuple[float, float, float, float]) -> None:
        fx, fy, cx, cy = intrinsics
        if not (fx > 0.0 and fy > 0.0 and math.isfinite(sum(intrinsics))):
            raise ScanError(f"camera_info K: fx {fx}, fy {fy} are not allowed, focal lengths above 0 px")
        key = (*shape, *intrinsics)
        if key == self._key:
            return
        step = self._settings.stride
        v, u = np.mgrid[step // 2 : shape[0] : step, step // 2 : shape[1] : step].astype(float)
        ahead = np.stack([np.ones_like(u), -(u - cx) / fx, -(v - cy) / fy], axis=-1)
        self._lengths = np.linalg.norm(ahead, axis=-1)
        self._directions = ahead / self._lengths[..., None]
        self._key = key
