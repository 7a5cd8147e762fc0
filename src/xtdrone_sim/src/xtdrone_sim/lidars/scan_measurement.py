"""Scans of a lidar: their times, the origins and hits of their rays, and the measurement."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.poses import Pose
from xtdrone_sim.lidars.ray_patterns import Rays, rays_of
from xtdrone_sim.rays.casting import PLACE, place_rays
from xtdrone_sim.rays.scene import Hits, Layout, cast
from xtdrone_sim.rays.tree import NOTHING
from xtdrone_sim.sensors.sensor_nodes import time_us
from xtdrone_sim.vehicles.mounts.lidar_mounts import LidarMount

WHITE = 100.0
"""Intensity of a surface that faces the lidar.

For others it is multiplied by the cosine of the angle between ray and normal (Lambert's law), regardless of distance
and colour.
"""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """Poses of all objects during a scan.

    Attributes:
        times_us: (k,) simulated times, microseconds, ascending.
        places: (k, m) ``casting.PLACE`` of the objects of ``layout``.
        link: (k,) ``casting.PLACE`` of the lidar's link.
        layout: the scene.
    """

    times_us: NDArray[np.int64]
    places: NDArray[np.void]
    link: NDArray[np.void]
    layout: Layout


@dataclass(frozen=True)
class Scan:
    """Measurement of one scan.

    Attributes:
        rays: directions, times and planes.
        ranges: (n,) m; infinite: no return; negative infinity: nearer than ``range_min``.
        intensities: (n,) 0..``WHITE``.
        owners: (n,) index of the hit model or vehicle in ``RayScene.owners``, or -1.
    """

    rays: Rays
    ranges: Array
    intensities: Array
    owners: NDArray[np.int64]


def begin_us(mount: LidarMount, number: int) -> int:
    """Return the time of a scan's first ray, microseconds."""
    return time_us(mount.rate, number)


def end_us(mount: LidarMount, number: int) -> int:
    """Return the time until which a scan needs the poses of moving objects, microseconds."""
    return begin_us(mount, number + 1 if mount.skew else number)


def link_places(poses: Sequence[Pose]) -> NDArray[np.void]:
    """Return poses as (k,) ``casting.PLACE``."""
    return np.array([(0, pose.position, pose.orientation) for pose in poses], PLACE)


def cast_scan(mount: LidarMount, number: int, motion: Motion, own: int = NOTHING) -> tuple[Rays, Hits]:
    """Cast the rays of a scan, without noise.

    Between two times of ``motion`` everything moves in a straight line and turns evenly. The error is a h^2 / 8 for an
    acceleration a and an interval h: 0.5 mm for 10 m/s^2 and 20 ms.

    Args:
        mount: the lidar.
        number: number of the scan since the start.
        motion: motion from before the scan's beginning until after its end.
        own: index of the vehicle, which its rays pass through.
    """
    rays = rays_of(mount, number)
    times = begin_us(mount, number) + 1e6 * rays.times
    known = motion.times_us.astype(float)
    segments = np.clip(np.searchsorted(known, times, side="right") - 1, 0, max(len(known) - 2, 0))
    widths = np.diff(known) if len(known) > 1 else np.ones(1)
    shares = np.clip((times - known[segments]) / widths[segments], 0.0, 1.0)
    origins, directions = np.empty((len(times), 3)), np.empty((len(times), 3))
    pose = mount.pose
    place_rays(
        motion.link, segments, shares, np.array(pose.position), np.array(pose.orientation), rays.directions,
        origins, directions,
    )  # fmt: skip
    return rays, cast(motion.layout, motion.places, segments, shares, origins, directions, mount.range_max, own)


def measure_scan(
    mount: LidarMount, vehicle: str, number: int, rays: Rays, hits: Hits, bias: float = 0.0, lost: float = 0.0
) -> Scan:
    """Return the measurement of hits: with noise, dropouts, resolution and limits of range.

    The random numbers depend only on seed, vehicle, name and number of the scan.

    Args:
        mount: the lidar.
        vehicle: name.
        number: number of the scan since the start.
        rays, hits: of the scan.
        bias: m, added to every range.
        lost: further share of the returns that are lost, 0..1.
    """
    ranges = hits.ranges.copy()
    share = 1.0 - (1.0 - mount.dropouts) * (1.0 - lost)
    if mount.noise > 0.0 or share > 0.0:
        key = zlib.crc32(f"{vehicle}/{mount.name}".encode()), number
        generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(mount.seed, spawn_key=key)))
        ranges += mount.noise * generator.standard_normal(len(ranges))
        ranges[generator.random(len(ranges)) < share] = np.inf
    ranges += bias
    if mount.resolution > 0.0:
        ranges = mount.resolution * np.round(ranges / mount.resolution)
    ranges[~(ranges <= mount.range_max)] = np.inf
    ranges[ranges < mount.range_min] = -np.inf
    intensities = np.where(np.isfinite(ranges), WHITE * hits.cosines, 0.0)
    return Scan(rays, ranges, intensities, hits.owners)
