"""Kernels that place a sensor's rays in the map: each at its own time, as the vehicle moves while a lidar turns."""

from __future__ import annotations

import numpy as np

from xtdrone_control import rotation_kernels
from xtdrone_planning.kernel import kernel

_rotate = rotation_kernels.rotate


@kernel
def place_rays(poses, spacing, mount, ranges, directions, times, origins, ends):
    """Compute where rays begin and end.

    Args:
        poses: (m, 7) of base_link in map, at times 0, ``spacing``, ...: x, y, z, m, and quaternion w, x, y, z.
        spacing: s between two poses, above 0.
        mount: (3,) the sensor's place in base_link, m, FLU; its axes are those of base_link.
        ranges: (n,) m.
        directions: (n, 3) unit vectors.
        times: (n,) s.
        origins, ends: (n, 3) m in map, the result.
    """
    pose = np.empty(7)
    for r in range(len(ranges)):
        place = min(max(times[r] / spacing, 0.0), len(poses) - 1.0)
        k = min(int(place), len(poses) - 2)
        part = place - k
        norm = 0.0
        for c in range(7):
            pose[c] = (1.0 - part) * poses[k, c] + part * poses[k + 1, c]
            if c >= 3:
                norm += pose[c] * pose[c]
        norm = 1.0 / np.sqrt(norm)
        q = (pose[3] * norm, pose[4] * norm, pose[5] * norm, pose[6] * norm)
        x, y, z = _rotate(q, mount[0], mount[1], mount[2])
        u, v, w = _rotate(q, directions[r, 0], directions[r, 1], directions[r, 2])
        origins[r, 0], origins[r, 1], origins[r, 2] = pose[0] + x, pose[1] + y, pose[2] + z
        ends[r, 0] = origins[r, 0] + ranges[r] * u
        ends[r, 1] = origins[r, 1] + ranges[r] * v
        ends[r, 2] = origins[r, 2] + ranges[r] * w
