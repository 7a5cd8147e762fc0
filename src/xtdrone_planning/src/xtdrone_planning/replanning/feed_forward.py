"""Acceleration setpoints with which an autopilot stays on a trajectory.

PX4's velocity controller (PositionControl.cpp) adds the acceleration setpoint to a proportional, an integral and a
derivative term. The derivative term, on the measured acceleration, works against the trajectory's acceleration. The
integral term takes over what holds against the air drag, and carries the vehicle beyond its stops, where there is no
drag: an iris from 4 m/s by 0.4 m. Setpoints that contain both leave neither to the controller.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.replanning.settings import PlannerSettings
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline

Array = NDArray[np.float64]


def acceleration_setpoint(trajectory: UniformSpline, time: float, settings: PlannerSettings) -> Array:
    """Return the acceleration setpoint, (3,) m/s^2 in map.

    Rotor drag is linear in the speed: M. Faessler, A. Franchi, D. Scaramuzza, Differential flatness of quadrotor
    dynamics subject to rotor drag for accurate tracking of high-speed trajectories, IEEE RA-L 3, 2018.

    Args:
        trajectory: the trajectory.
        time: of the position and velocity setpoints that go with it, s of ROS time.
        settings: lag of the attitude, drag and damping.
    """
    _, velocity, acceleration = trajectory.at(time + settings.attitude_lag)
    level = (1.0 + settings.damping) * acceleration[:2] + settings.drag * velocity[:2]
    return np.array([*level, acceleration[2]])
