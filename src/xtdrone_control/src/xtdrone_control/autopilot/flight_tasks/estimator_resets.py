"""Shifts of the smoothed path by resets of the estimator, as in PX4's flight tasks.

A held position or smoothed path (``CONTROL.smooth_*``) moves with the estimate, so that a reset causes no motion. Goals
and OFFBOARD setpoints are not shifted; the vehicle flies to them on its smoothed path.
"""

from __future__ import annotations

from xtdrone_control.kernel import kernel
from xtdrone_control.rotation_kernels import wrap_pi


@kernel
def follow_resets(c, e):
    """Shift the smoothed path by the estimator's resets since the last call.

    Args:
        c: ``CONTROL`` record.
        e: ``ESTIMATOR`` record.
    """
    if c.resets_seen == e.reset_counter:
        return
    c.resets_seen = e.reset_counter
    if c.resets_seen_xy != e.reset_counter_xy:
        c.resets_seen_xy = e.reset_counter_xy
        for i in range(2):
            c.smooth_position[i] += e.delta_xy[i]
    if c.resets_seen_vxy != e.reset_counter_vxy:
        c.resets_seen_vxy = e.reset_counter_vxy
        for i in range(2):
            c.smooth_velocity[i] += e.delta_vxy[i]
    if c.resets_seen_z != e.reset_counter_z:
        c.resets_seen_z = e.reset_counter_z
        c.smooth_position[2] += e.delta_z
    if c.resets_seen_vz != e.reset_counter_vz:
        c.resets_seen_vz = e.reset_counter_vz
        c.smooth_velocity[2] += e.delta_vz
    if c.resets_seen_heading != e.reset_counter_heading:
        c.resets_seen_heading = e.reset_counter_heading
        c.smooth_yaw = wrap_pi(c.smooth_yaw + e.delta_heading)
