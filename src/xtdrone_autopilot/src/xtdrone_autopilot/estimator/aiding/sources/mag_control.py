"""Aiding by the magnetometer: use, rejection and recovery of the magnetic heading.

After PX4's mag_control and mag_heading_control.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.estimator.aiding.source_timeouts import RESET_US, is_recent
from xtdrone_autopilot.estimator.fusion import (
    YAW_UNKNOWN_STD,
    fuse_heading,
    magnetic_heading,
    reset_mag_bias,
    reset_yaw,
    track_field,
)
from xtdrone_autopilot.kernel import kernel

_MAG_START_US = 1_000_000  # required duration of an undisturbed field (PX4: min_mag_health_time)
_FIELD_STRENGTH, _FIELD_TOLERANCE = 0.45, 0.25  # gauss; PX4's average over the Earth
# EKF2_MAG_TYPE
_MAG_NONE, _MAG_INIT = 5, 6


@kernel
def process_mag(e, s, p, work):
    """Process a sample of the magnetic field."""
    e.time_mag_us = s.time_us
    if not e.in_air:
        e.mag_fault = 0
    if not _mag_usable(e, s, p):
        e.mag_used = 0
        e.test_ratio.mag = 0.0
        return
    track_field(e.field, e, s)
    if not e.heading_aligned:
        e.mag_resets = 1
        _reset_heading_to_mag(e, s, p, work)
        return
    if not e.mag_used:
        e.mag_used = e.mag_resets = 1
        e.time_heading_fuse_us = s.time_us
    fuse_heading(e, s, p, work)
    if not is_recent(s.time_us, e.time_heading_fuse_us, RESET_US):
        _recover_mag(e, s, p, work)


@kernel
def _mag_usable(e, s, p):
    """Update ``mag_good``; return whether the magnetic heading is enabled and plausible."""
    strength = math.sqrt(s.mag[0] ** 2 + s.mag[1] ** 2 + s.mag[2] ** 2)
    disturbed = abs(strength - _FIELD_STRENGTH) > _FIELD_TOLERANCE
    if disturbed:
        e.time_mag_disturbed_us = s.time_us
    e.mag_good = not disturbed and not e.mag_fault
    kind = int(p.ekf2_mag_type)
    rejected = int(p.ekf2_mag_check) & 1 and is_recent(s.time_us, e.time_mag_disturbed_us, _MAG_START_US)
    first_only = kind == _MAG_INIT and e.heading_aligned
    return not (kind == _MAG_NONE or rejected or first_only or e.mag_fault or e.vision_yaw_used)


@kernel
def _recover_mag(e, s, p, work):
    """Reset the heading and the bias to a magnetometer that has been rejected for ``RESET_US``.

    In the air this happens once; a magnetometer that is rejected again is declared faulty until landing, as in PX4's
    mag_heading_control.
    """
    if e.in_air and not e.mag_resets:
        e.mag_fault = 1
        e.mag_used = e.mag_good = 0
        e.test_ratio.mag = 0.0
        return
    reset_mag_bias(e, p.ekf2_mag_noise**2)
    _reset_heading_to_mag(e, s, p, work)
    if e.in_air:
        e.mag_resets -= 1


@kernel
def _reset_heading_to_mag(e, s, p, work):
    """Reset the heading to the magnetic heading.

    The heading is first declared unknown and then measured. Its variance therefore contains the errors of the sample
    and of the bias, with the right correlations to the other states.
    """
    innovation, _, _, found = magnetic_heading(e, s, math.radians(p.ekf2_mag_decl))
    if not found:
        return
    reset_yaw(e, innovation, YAW_UNKNOWN_STD**2)
    fuse_heading(e, s, p, work)
    e.heading_aligned = e.mag_used = 1
    e.time_heading_fuse_us = s.time_us
