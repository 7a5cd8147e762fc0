"""Flight task of ORBIT: a circle around a point (PX4: FlightTaskOrbit)."""

from __future__ import annotations

import math

from xtdrone_control.autopilot.flight_tasks.motion_planning.smoothing import smooth_yaw
from xtdrone_control.autopilot.state import ORBIT_ALONG_CIRCLE, ORBIT_INITIAL_HEADING, ORBIT_UNCONTROLLED
from xtdrone_control.kernel import kernel

_NAN = math.nan


@kernel
def _orbit_heading(s, x, y):
    """Return the heading (rad; NaN: not controlled) at the unit vector (x, y) from the centre to the vehicle."""
    if s.orbit_yaw == ORBIT_UNCONTROLLED:
        return _NAN
    if s.orbit_yaw == ORBIT_INITIAL_HEADING:
        return s.orbit_heading
    if s.orbit_yaw == ORBIT_ALONG_CIRCLE:
        sign = 1.0 if s.orbit_speed > 0.0 else -1.0
        return math.atan2(sign * x, -sign * y)
    return math.atan2(-y, -x)


@kernel
def orbit_task(c, s, e, p, dt):
    """Fly along the circle, returning to it at 1 m/s per metre (PX4 FlightTaskOrbit::generate_circle_setpoints)."""
    x, y = e.position[0] - s.orbit_centre[0], e.position[1] - s.orbit_centre[1]
    distance = math.hypot(x, y)
    x, y = (x / distance, y / distance) if distance > 1e-6 else (1.0, 0.0)
    pull = s.orbit_radius - distance
    c.task_velocity[0] = -y * s.orbit_speed + x * pull
    c.task_velocity[1] = x * s.orbit_speed + y * pull
    inwards = s.orbit_speed * s.orbit_speed / s.orbit_radius
    c.task_acceleration[0] = -x * inwards
    c.task_acceleration[1] = -y * inwards
    c.task_position[2] = s.goal_position[2]
    heading = _orbit_heading(s, x, y)
    if not math.isnan(heading):
        smooth_yaw(c, heading, p, dt)
