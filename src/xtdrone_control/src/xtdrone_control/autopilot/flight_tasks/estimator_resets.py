"""Shifts of the smoothed path by resets of the estimator, as in PX4's flight tasks.

A held position or smoothed path (``CONTROL.path``) moves with the estimate, so that a reset causes no motion. Goals
and OFFBOARD setpoints are not shifted; the vehicle flies to them on its smoothed path.
"""

from __future__ import annotations

import math

from xtdrone_control.kernel import kernel
from xtdrone_control.rotation_kernels import wrap_pi


@kernel
def follow_resets(path, last_velocity, seen, resets, shifts):
    """Shift the smoothed path by the estimator's resets since the last call; restart the velocity's derivative.

    Args:
        path: ``PATH`` record.
        last_velocity: m/s, local, shape (3,), set to NaN by a reset of the velocity.
        seen: ``RESETS`` record of the resets already applied.
        resets: ``RESETS`` record of the estimator.
        shifts: its ``SHIFTS`` record.
    """
    if seen.any == resets.any:
        return
    seen.any = resets.any
    if seen.xy != resets.xy:
        seen.xy = resets.xy
        for i in range(2):
            path.position[i] += shifts.xy[i]
    if seen.vxy != resets.vxy:
        seen.vxy = resets.vxy
        for i in range(2):
            path.velocity[i] += shifts.vxy[i]
            last_velocity[i] = math.nan
    if seen.z != resets.z:
        seen.z = resets.z
        path.position[2] += shifts.z
    if seen.vz != resets.vz:
        seen.vz = resets.vz
        path.velocity[2] += shifts.vz
        last_velocity[2] = math.nan
    if seen.heading != resets.heading:
        seen.heading = resets.heading
        path.yaw = wrap_pi(path.yaw + shifts.heading)
