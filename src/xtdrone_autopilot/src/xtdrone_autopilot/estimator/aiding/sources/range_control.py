"""Aiding by a range finder: height above ground and terrain (PX4: range_height_control, terrain_estimator)."""

from __future__ import annotations

import math

from xtdrone_autopilot.estimator.aiding.source_timeouts import HEIGHT_RESET_US, is_recent
from xtdrone_autopilot.estimator.aiding.sources.height_control import fuse_height
from xtdrone_autopilot.estimator.fusion import to_origin
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import HEIGHT_RANGE
from xtdrone_common.rotation_kernels import constrain

LEAST_TERRAIN_VARIANCE = 1e-4  # m^2
_DELAY = 5.0  # ms, of the simulated sensor (EKF2_RNG_DELAY's default)
_TERRAIN_RATE = 0.01  # s, PX4's filter period, for which EKF2_TERR_NOISE is defined
LEVEL_COSINE = 0.7  # of the largest tilt at which range and flow are fused (PX4: 45 deg)


@kernel
def tilt_cosine(e):
    """Return the cosine of the angle between body z and down."""
    return 1.0 - 2.0 * (e.q[1] * e.q[1] + e.q[2] * e.q[2])


@kernel
def process_range(e, s, p, work):
    """Process a range measured along body z: terrain, and height if EKF2_RNG_CTRL allows it."""
    usable = s.range_quality != 0 and s.range_least <= s.range_distance <= s.range_largest
    cosine = tilt_cosine(e)
    since = constrain((s.time_us - e.time_range_us) * 1e-6, 0.0, 1.0)
    e.time_range_us = s.time_us
    e.range_good = usable
    if not usable or cosine < LEVEL_COSINE:
        return
    lag = (p.ekf2_rng_delay - _DELAY) * 1e-3
    shift, _ = to_origin(e, s, p.ekf2_rng_pos_x, p.ekf2_rng_pos_y, p.ekf2_rng_pos_z, lag)
    hagl = max(s.range_distance * cosine - shift[2], p.ekf2_min_rng)
    variance = (p.ekf2_rng_noise**2 + (p.ekf2_rng_sfe * s.range_distance) ** 2) * cosine * cosine
    _fuse_terrain(e, s, p, hagl, variance, since)
    is_reference = int(p.ekf2_hgt_ref) == HEIGHT_RANGE
    control = int(p.ekf2_rng_ctrl)
    speed = math.sqrt(e.velocity[0] ** 2 + e.velocity[1] ** 2)
    low_and_slow = hagl < p.ekf2_rng_a_hmax and speed < p.ekf2_rng_a_vmax
    if control == 0 or not (is_reference or control == 2 or low_and_slow):
        e.height_used[HEIGHT_RANGE] = 0
        return
    e.innovation.range = e.height_offset[HEIGHT_RANGE] - hagl - e.position[2]
    e.test_ratio.range = fuse_height(e, s, p, HEIGHT_RANGE, -hagl, variance, p.ekf2_rng_gate, work)


@kernel
def _fuse_terrain(e, s, p, hagl, variance, since):
    """Update the scalar Kalman filter of the terrain's down coordinate, as in PX4 v1.14."""
    measured = e.position[2] + hagl
    noise = variance + e.P[8, 8]
    if not is_recent(s.time_us, e.time_terrain_fuse_us, HEIGHT_RESET_US):
        e.terrain = measured
        e.terrain_variance = noise
        e.time_terrain_fuse_us = s.time_us
        return
    e.terrain_variance += p.ekf2_terr_noise**2 * _TERRAIN_RATE * since
    innovation = measured - e.terrain
    total = e.terrain_variance + noise
    e.test_ratio.terrain = innovation * innovation / (p.ekf2_rng_gate**2 * total)
    if e.test_ratio.terrain > 1.0:
        return
    gain = e.terrain_variance / total
    e.terrain += gain * innovation
    e.terrain_variance = max((1.0 - gain) * e.terrain_variance, LEAST_TERRAIN_VARIANCE)
    e.time_terrain_fuse_us = s.time_us
