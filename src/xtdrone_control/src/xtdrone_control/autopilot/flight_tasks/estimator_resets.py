"""Keeps the smoothed path where the vehicle is when the estimator resets its state, as PX4's flight tasks do.

What the vehicle holds or follows by itself (``CONTROL.smooth_*``) jumps with the estimate, so that nothing is to be
caught up with. Goals and OFFBOARD setpoints stay as they were given: they are places, and the vehicle flies there on
its smoothed path.
"""

from __future__ import annotations

from xtdrone_control.kernel import kernel
from xtdrone_control.rotation_kernels import wrap_pi


@kernel
def follow_resets(c, e):
    """Shift the smoothed path by the resets since the last call.

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
