"""Collision prevention in POSCTL, after PX4 v1.14's lib/collision_prevention: a map of distances around the vehicle.

The map (``OBSTACLES``) has 36 directions of 10 degrees in the body frame, clockwise from the nose, filled by
``obstacle_map`` from OBSTACLE_DISTANCE and DISTANCE_SENSOR. ``prevent_collision`` turns and shortens the velocity by
stick, so that the vehicle can stop CP_DIST from every obstacle.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.flight_tasks.motion_planning.jerk_limited_velocity import stopping_speed
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import OBSTACLE_BINS, OBSTACLE_UNKNOWN
from xtdrone_common.rotation_kernels import yaw_of

_BIN = 360 // OBSTACLE_BINS  # degrees
_TIMEOUT_US = 500_000  # age at which data no longer count
_HOLD_US = 5_000_000  # age of the newest data, and time in POSCTL, after which the vehicle changes to hold
_WARNING_US = 1_000_000
_NOT_ACTIVE = -1
_LEAST_SPEED = 0.001  # m/s, commanded
_LEAST_PROJECTION = 0.01
_MANY = 9999.0


@kernel
def start_prevention(o, now_us):
    """Empty the map ``o`` at the start of POSCTL; it counts as recent."""
    o.active_us = _NOT_ACTIVE
    o.warned_us = 0
    o.hold = 0
    o.time_us = now_us
    o.least = OBSTACLE_UNKNOWN
    o.largest = 0.0
    for i in range(OBSTACLE_BINS):
        o.distances[i] = OBSTACLE_UNKNOWN
        o.ranges[i] = 0.0
        o.times_us[i] = now_us
        o.covered[i] = 0


@kernel
def _guide(o, bin_wanted, keep, angle):
    """Return the direction within ``angle`` degrees of the wanted one that has the most room (PX4's setpoint guidance).

    A deviation by one direction costs as much as half of ``keep``, m. Distances are averages over three directions.
    """
    best, found = _MANY, bin_wanted
    most = int(angle // _BIN)
    for i in range(bin_wanted - most, bin_wanted + most + 1):
        mean = 0.0
        for j in range(i - 1, i + 2):
            distance = o.distances[j % OBSTACLE_BINS]
            mean += keep * 100.0 if distance == OBSTACLE_UNKNOWN else distance
        distance = o.distances[i % OBSTACLE_BINS]
        cost = keep * 50.0 * abs(i - bin_wanted) - mean / 3.0 - distance
        if cost < best and distance != OBSTACLE_UNKNOWN:
            best, found = cost, i % OBSTACLE_BINS
    return found


@kernel
def _limit_speed(o, i, e, p, direction_x, direction_y, towards_x, towards_y, now_us):
    """Return the largest speed in a direction (unit vector) with the obstacle of map direction ``i`` (``towards``)."""
    projection = direction_x * towards_x + direction_y * towards_y
    if projection <= _LEAST_PROJECTION:
        return math.inf
    closing = max(0.0, e.velocity[0] * towards_x + e.velocity[1] * towards_y)
    delay = closing * p.cp_delay
    if o.distances[i] < o.ranges[i]:
        delay += closing * (now_us - o.times_us[i]) * 1e-6
    keep = max(o.least * 0.01, p.cp_dist)
    room = max(0.0, o.distances[i] * 0.01 - keep - delay)
    return min(p.mpc_xy_p * room, stopping_speed(room, p.mpc_acc_hor, p.mpc_jerk_max, 0.0)) / projection


@kernel
def _request_hold(o, now_us):
    """Request the hold mode, at most once a second, when data have been missing for long."""
    if now_us - o.warned_us <= _WARNING_US or now_us - o.active_us <= _WARNING_US:
        return
    o.warned_us = now_us
    if now_us - o.time_us > _HOLD_US and now_us - o.active_us > _HOLD_US:
        o.hold = 1


@kernel
def prevent_collision(o, e, p, x, y):
    """Return the horizontal velocity (tuple, m/s, local) that obstacles leave of the wanted velocity ``x``, ``y``.

    Without recent data, and without data in the direction of the velocity, it is 0; CP_GO_NO_DATA allows directions
    without data, except those that a sensor has covered before.
    """
    now_us = e.time_imu_us
    if o.active_us == _NOT_ACTIVE:
        o.active_us = now_us
    if now_us - o.time_us >= _TIMEOUT_US:
        _request_hold(o, now_us)
        return 0.0, 0.0
    speed = math.hypot(x, y)
    if speed <= _LEAST_SPEED:
        return x, y
    direction_x, direction_y = x / speed, y / speed
    yaw = yaw_of(e.q)
    wanted = math.degrees(math.atan2(direction_y, direction_x) - yaw) % 360.0
    wanted_bin = int(wanted // _BIN) % OBSTACLE_BINS
    bin_used = _guide(o, wanted_bin, p.cp_dist, p.cp_guide_ang)
    if bin_used != wanted_bin:
        angle = yaw + math.radians(bin_used * _BIN)
        direction_x, direction_y = math.cos(angle), math.sin(angle)
    known = 0
    for i in range(OBSTACLE_BINS):
        if now_us - o.times_us[i] > _TIMEOUT_US:
            o.distances[i] = OBSTACLE_UNKNOWN
        if o.distances[i] < OBSTACLE_UNKNOWN:
            known += 1
            if o.distances[i] > o.least:
                angle = yaw + math.radians(i * _BIN)
                towards_x, towards_y = math.cos(angle), math.sin(angle)
                speed = min(speed, _limit_speed(o, i, e, p, direction_x, direction_y, towards_x, towards_y, now_us))
        elif i == bin_used and (p.cp_go_no_data < 0.5 or o.covered[i]):
            speed = 0.0
    if known == 0:
        speed = 0.0
    return direction_x * speed, direction_y * speed
