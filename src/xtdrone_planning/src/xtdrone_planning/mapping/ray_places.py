"""Rays of a sensor in the map frame, each placed at its own time, because the vehicle moves during a scan."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common import rotation_kernels
from xtdrone_common.pose_history import PoseHistory
from xtdrone_planning.kernel import kernel
from xtdrone_planning.mapping.range_images import RangeImage

Array = NDArray[np.float64]

_PIECES = 6  # intervals per scan, within which the vehicle's pose is interpolated


class PlacedRays(NamedTuple):
    """The rays of a measurement in the map.

    Attributes:
        origins: (n, 3) where they begin, m in map.
        ends: (n, 3) where they end.
        hits: (n,) whether the ray ends at a surface.
        position: (3,) of the vehicle at the end of the measurement, m in map.
    """

    origins: Array
    ends: Array
    hits: NDArray[np.bool_]
    position: Array


def rays_in_map(
    image: RangeImage, stamp_ns: int, mount: tuple[float, float, float], poses: PoseHistory, *, by_columns: bool = False
) -> PlacedRays | None:
    """Return the rays of a measurement, each from the vehicle's pose at the time of the ray.

    Args:
        image: the rays.
        stamp_ns: time of the image, ns.
        mount: the sensor's place in base_link, m, FLU.
        poses: Poses of base_link, entries x, y, z, m in map, and quaternion w, x, y, z.
        by_columns: see ``RangeImage.rays``.

    Returns:
        None if the pose at one of the times is not known.
    """
    ranges, directions, times, hits = image.rays(by_columns=by_columns)
    seconds = max(float(times.max()) if len(times) else 0.0, 1e-3)
    known = poses.during(stamp_ns, seconds, _PIECES)
    if known is None:
        return None
    origins, ends = np.empty_like(directions), np.empty_like(directions)
    place_rays(known, seconds / _PIECES, np.array(mount), ranges, directions, times, origins, ends)
    return PlacedRays(origins, ends, hits, known[-1][:3])


_rotate = rotation_kernels.rotate


@kernel
def place_rays(poses, spacing, mount, ranges, directions, times, origins, ends):
    """Compute the start and end points of rays.

    Args:
        poses: (m, 7) of base_link in map, at times 0, ``spacing``, ...: x, y, z, m, and quaternion w, x, y, z.
        spacing: s between two poses, above 0.
        mount: (3,) position of the sensor in base_link, m, FLU; its axes are those of base_link.
        ranges: (n,) m.
        directions: (n, 3) unit vectors.
        times: (n,) s.
        origins, ends: (n, 3) m in map, the result.
    """
    pose = np.empty(7)
    q, x, y, z = (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0
    for r in range(len(ranges)):
        if r == 0 or times[r] != times[r - 1]:  # the rays of a lidar's column have the same time
            q = _pose_at(poses, min(max(times[r] / spacing, 0.0), len(poses) - 1.0), pose)
            x, y, z = _rotate(q, mount[0], mount[1], mount[2])
        u, v, w = _rotate(q, directions[r, 0], directions[r, 1], directions[r, 2])
        origins[r, 0], origins[r, 1], origins[r, 2] = pose[0] + x, pose[1] + y, pose[2] + z
        ends[r, 0] = origins[r, 0] + ranges[r] * u
        ends[r, 1] = origins[r, 1] + ranges[r] * v
        ends[r, 2] = origins[r, 2] + ranges[r] * w


@kernel
def leave_out_places(origins, ends, hits, places, reach):
    """Move the rays that do not end near one of some places to the front, in their order; return their number.

    Args:
        origins: (n, 3) where they begin, m in map; changed, as are ``ends`` and ``hits``.
        ends: (n, 3) where they end, m in map.
        hits: (n,) whether something was met there; rays that met nothing are never near.
        places: (m, 3) m in map.
        reach: (m,) m.
    """
    count = 0
    for k in range(len(ends)):
        x, y, z = ends[k, 0], ends[k, 1], ends[k, 2]
        if hits[k] and _is_near(x, y, z, places, reach):
            continue
        if count < k:
            for c in range(3):
                origins[count, c] = origins[k, c]
            ends[count, 0], ends[count, 1], ends[count, 2] = x, y, z
            hits[count] = hits[k]
        count += 1
    return count


@kernel
def _is_near(x, y, z, places, reach):
    for n in range(len(places)):
        u, v, w = x - places[n, 0], y - places[n, 1], z - places[n, 2]
        if u * u + v * v + w * w < reach[n] * reach[n]:
            return True
    return False


@kernel
def _pose_at(poses, place, pose):
    """Interpolate poses at ``place``, counted in poses, into ``pose`` (7,); return the unit quaternion."""
    k = min(int(place), len(poses) - 2)
    part = place - k
    norm = 0.0
    for c in range(7):
        pose[c] = (1.0 - part) * poses[k, c] + part * poses[k + 1, c]
        if c >= 3:
            norm += pose[c] * pose[c]
    norm = 1.0 / np.sqrt(norm)
    return pose[3] * norm, pose[4] * norm, pose[5] * norm, pose[6] * norm
