"""Shifts of the smoothed path by resets of the estimator, as in PX4's flight tasks.

A held position or smoothed path (``CONTROL.path``) moves with the estimate, so that a reset causes no motion. Goals
and OFFBOARD setpoints are not shifted; the vehicle flies to them on its smoothed path.
"""

from __future__ import annotations

from xtdrone_control.kernel import kernel
from xtdrone_control.rotation_kernels import wrap_pi


@kernel
def follow_resets(path, seen, e):
    """Shift the smoothed path by the estimator's resets since the last call.

    Args:
        path: ``PATH`` record.
        seen: ``RESETS`` record of the resets already applied.
        e: ``ESTIMATOR`` record.
    """
    if seen.any == e.reset_counter:
        return
    seen.any = e.reset_counter
    if seen.xy != e.reset_counter_xy:
        seen.xy = e.reset_counter_xy
        for i in range(2):
            path.position[i] += e.delta_xy[i]
    if seen.vxy != e.reset_counter_vxy:
        seen.vxy = e.reset_counter_vxy
        for i in range(2):
            path.velocity[i] += e.delta_vxy[i]
    if seen.z != e.reset_counter_z:
        seen.z = e.reset_counter_z
        path.position[2] += e.delta_z
    if seen.vz != e.reset_counter_vz:
        seen.vz = e.reset_counter_vz
        path.velocity[2] += e.delta_vz
    if seen.heading != e.reset_counter_heading:
        seen.heading = e.reset_counter_heading
        path.yaw = wrap_pi(path.yaw + e.delta_heading)
