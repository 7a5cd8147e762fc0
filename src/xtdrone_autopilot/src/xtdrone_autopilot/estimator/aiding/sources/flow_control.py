"""Aiding by optical flow (PX4: optical_flow_control)."""

from __future__ import annotations

import math

from xtdrone_autopilot.estimator.aiding.source_timeouts import HEIGHT_RESET_US, RESET_US, is_recent, mark_located
from xtdrone_autopilot.estimator.aiding.sources.range_control import LEAST_TERRAIN_VARIANCE, LEVEL_COSINE, tilt_cosine
from xtdrone_autopilot.estimator.fusion import fuse_flow, reset_position, reset_velocity, to_origin
from xtdrone_autopilot.kernel import kernel
from xtdrone_common.rotation_kernels import constrain, rotate, yaw_of

_DELAY = 20.0  # ms, of the simulated camera (EKF2_OF_DELAY's default)


@kernel
def process_flow(e, s, p, work):
    """Process a sample of optical flow, which needs a known height above ground."""
    e.time_flow_us = s.time_us
    e.flow_good = s.flow_quality >= p.ekf2_of_qmin
    known = is_recent(s.time_us, e.time_terrain_fuse_us, HEIGHT_RESET_US)
    if not int(p.ekf2_of_ctrl) or not e.flow_good or not known or tilt_cosine(e) < LEVEL_COSINE:
        return
    lag = (p.ekf2_of_delay - _DELAY) * 1e-3
    shift, extra = to_origin(e, s, p.ekf2_of_pos_x, p.ekf2_of_pos_y, p.ekf2_of_pos_z, lag)
    hagl = max(e.terrain - e.position[2] + shift[2], p.ekf2_min_rng)
    share = (s.flow_quality - p.ekf2_of_qmin) / max(255.0 - p.ekf2_of_qmin, 1.0)
    noise = p.ekf2_of_n_max + (p.ekf2_of_n_min - p.ekf2_of_n_max) * constrain(share, 0.0, 1.0)
    gx, gy = s.flow_gyro[0], s.flow_gyro[1]
    if math.isnan(gx) or math.isnan(gy):
        gx, gy = e.rates[0], e.rates[1]
    reach = hagl / tilt_cosine(e)
    forward, right, _ = rotate((e.q[0], -e.q[1], -e.q[2], -e.q[3]), extra[0], extra[1], extra[2])
    x, y = s.flow_rate[0] - gx - right / reach, s.flow_rate[1] - gy + forward / reach
    speed_error = (x * x + y * y) * e.terrain_variance / (hagl * hagl)
    if not e.flow_used:
        _start_flow(e, s, x, y, hagl, noise)
        return
    e.test_ratio.flow = fuse_flow(e, x, y, hagl, noise**2 + speed_error, p.ekf2_of_gate, work)
    if e.test_ratio.flow <= 1.0:
        e.time_flow_fuse_us = e.time_last_vel_fuse_us = s.time_us
    elif not is_recent(s.time_us, e.time_flow_fuse_us, RESET_US):
        e.flow_used = 0


@kernel
def _start_flow(e, s, x, y, hagl, noise):
    """Start fusing optical flow; without another horizontal source, reset the velocity to it and keep the position."""
    e.flow_used = 1
    e.time_flow_fuse_us = s.time_us
    if e.gps_used or e.vision_position_used or e.vision_velocity_used:
        return
    reach = hagl / tilt_cosine(e)
    north, east = _heading_to_local(e, y * reach, -x * reach)
    reset_velocity(e, north, east, (noise * reach) ** 2)
    if not e.located:
        reset_position(e, e.position[0], e.position[1], LEAST_TERRAIN_VARIANCE)
    mark_located(e, s)


@kernel
def _heading_to_local(e, forward, right):
    """Return (north, east) of a horizontal vector given as (forward, right) of the heading."""
    yaw = yaw_of(e.q)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return cos * forward - sin * right, sin * forward + cos * right
