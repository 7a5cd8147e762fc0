"""The autopilot's inner loops for all vehicles: estimator, control cascade, allocation, land detection, at 250 Hz.

Free of ROS, MAVLink and mode logic. Commander and navigator write ``setpoint``; sensors are written before each step;
``control["actuators"]`` is what the motors get.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .attitude_control import attitude_control
from .control_allocator import allocate, mixing_matrix
from .estimator import update as update_estimator
from .flight_tasks import generate_setpoint
from .kernel import kernel
from .land_detector import detect_landing
from .logger.folder import LogFolder
from .parameters import PARAMS
from .position_control import position_loop, thrust_to_attitude, update_hover_thrust, velocity_loop
from .rate_control import rate_control
from .reset_follower import follow_resets
from .state import (
    CONTROL,
    ESTIMATOR,
    FAILURES,
    MAX_ROTORS,
    N_STATES,
    SENSORS,
    SETPOINT,
    TAKEOFF_FLIGHT,
    TAKEOFF_RAMPUP,
    TASK_ATTITUDE,
    TASK_DESCEND,
    TASK_IDLE,
    TASK_LAND,
    TASK_RATES,
    records,
)
from .takeoff import update_takeoff, wants_takeoff
from .vibration import update_vibration

STEP_US = 4000  # PX4's SITL lockstep period


@dataclass(frozen=True)
class Datum:
    """WGS84 origin of a local frame: degrees and metres AMSL."""

    latitude: float
    longitude: float
    altitude: float


@dataclass(frozen=True)
class RotorLayout:
    """Rotor places (n, 3) in body FRD, m, and their moment-to-thrust ratios (n,), m, positive counter-clockwise."""

    positions: NDArray[np.float64]
    moment_ratios: NDArray[np.float64]


@kernel
def _no_thrust(c):
    """Ask for no thrust and no torque, and forget the integrals."""
    for i in range(3):
        c.velocity_integral[i] = 0.0
        c.rate_integral[i] = 0.0
        c.sp_thrust_vector[i] = 0.0
        c.sp_rates[i] = 0.0
        c.sp_torque[i] = 0.0
    c.sp_thrust = 0.0


@kernel
def _stop(c):
    """Disarmed: motors off."""
    _no_thrust(c)
    for i in range(MAX_ROTORS):
        c.actuators[i] = 0.0


@kernel
def _hold_on_ground(c, e):
    """Armed on the ground: motors idle, the attitude set-point is the present attitude."""
    _no_thrust(c)
    for i in range(4):
        c.sp_q[i] = e.q[i]


@kernel
def _follow_trajectory(c, s, e, p, dt):
    """Position, velocity and attitude loops."""
    landing = s.task == TASK_LAND or s.task == TASK_DESCEND
    speed_up, speed_down = p.mpc_z_vel_max_up, p.mpc_z_vel_max_dn
    tilt = math.radians(p.mpc_tiltmax_air)
    if c.takeoff_state == TAKEOFF_RAMPUP:
        speed_up = min(speed_up, c.ramp_speed)
        speed_down = max(speed_down, -speed_up)
        c.sp_acceleration[2] = math.nan
        tilt = math.radians(p.mpc_tiltmax_lnd)
    elif landing and c.ground_contact:
        tilt = math.radians(p.mpc_tiltmax_lnd)
    position_loop(c, e, p, speed_up, speed_down)
    velocity_loop(c, e, p, dt, tilt, p.mpc_thr_max)
    thrust_to_attitude(c, e)
    attitude_control(c, e, p)
    in_flight = c.takeoff_state == TAKEOFF_FLIGHT and not c.ground_contact
    if p.mpc_use_hte > 0.5 and in_flight:
        update_hover_thrust(c, e, p, dt)


@kernel
def _follow_attitude(c, s, e, p):
    """TASK_ATTITUDE and TASK_RATES: set-points past the position control."""
    c.sp_thrust = min(max(s.thrust, 0.0), 1.0)
    if s.task == TASK_RATES:
        for i in range(3):
            # a rate that is not controlled is let go on as it is
            c.sp_rates[i] = e.rates[i] if math.isnan(s.rates[i]) else s.rates[i]
    else:
        for i in range(4):
            c.sp_q[i] = s.attitude_q[i]
        c.sp_yaw_rate = s.rates[2]
        attitude_control(c, e, p)
    for i in range(2):
        c.sp_thrust_vector[i] = 0.0
    c.sp_thrust_vector[2] = -c.sp_thrust


@kernel
def _control_vehicle(sensors, e, s, c, p, mix, rotors, dt):
    by_attitude = s.task == TASK_ATTITUDE or s.task == TASK_RATES
    follow_resets(c, e)
    generate_setpoint(c, s, e, p, dt)
    wants = s.thrust > p.mpc_thr_min if by_attitude else wants_takeoff(c, e)
    update_takeoff(c, s, e, p, dt, wants)
    if not s.armed:
        _stop(c)
    elif s.task == TASK_IDLE or c.takeoff_state < TAKEOFF_RAMPUP or (c.ground_contact and not by_attitude):
        _hold_on_ground(c, e)
        allocate(c, mix, rotors)
    else:
        if by_attitude:
            _follow_attitude(c, s, e, p)
        else:
            _follow_trajectory(c, s, e, p, dt)
        rate_control(c, e, p, dt, not c.maybe_landed)
        allocate(c, mix, rotors)
    detect_landing(c, s, e, sensors, p, dt, wants)


@kernel
def step_all(sensors, estimator, setpoint, control, params, mix, rotors, dt, work):
    """Run one step of every vehicle.

    Args:
        sensors, estimator, setpoint, control, params: record arrays, shape (n,).
        mix: (n, 4, MAX_ROTORS) mixers, see ``control_allocator.allocate``.
        rotors: (n,) rotor counts.
        dt: s.
        work: (2, N_STATES) scratch.
    """
    for i in range(sensors.shape[0]):
        update_vibration(estimator[i], sensors[i], dt)
        update_estimator(estimator[i], sensors[i], params[i], dt, work)
        if estimator[i].initialised:
            _control_vehicle(
                sensors[i], estimator[i], setpoint[i], control[i], params[i], mix[i], rotors[i], dt
            )  # fmt: skip


class Autopilot:
    """State and inner loops of ``count`` vehicles.

    Attributes:
        sensors, estimator, setpoint, control, failures, params: record arrays of ``state`` and ``parameters``, shape
            (count,).
        rotors: how many motors each vehicle has, shape (count,).
        time_us: simulated time, microseconds, of the last step.
        logs: where each vehicle's logs lie; empty when none are written.
    """

    def __init__(self, layouts: Sequence[RotorLayout], datum: Datum | None) -> None:
        """Make the state of ``len(layouts)`` vehicles.

        Args:
            layouts: one rotor layout a vehicle.
            datum: the local frame's origin that all vehicles share; None lets each start at its first GPS fix.
        """
        self.count = len(layouts)
        self.time_us = 0
        self.logs: Sequence[LogFolder] = ()
        self.sensors = records(SENSORS, self.count)
        self.estimator = records(ESTIMATOR, self.count)
        self.setpoint = records(SETPOINT, self.count)
        self.control = records(CONTROL, self.count)
        self.failures = records(FAILURES, self.count)
        self.params = records(PARAMS, self.count)
        self.estimator["q"][:, 0] = 1.0
        self.control["landed"] = 1
        self.control["sp_q"][:, 0] = 1.0
        if datum is not None:
            self.estimator["origin_lat"] = datum.latitude
            self.estimator["origin_lon"] = datum.longitude
            self.estimator["origin_alt"] = datum.altitude
            self.estimator["origin_set"] = 1
        for field in ("position", "velocity", "acceleration", "goal_position", "onward_position"):
            self.setpoint[field] = np.nan
        for field in ("yaw", "yaw_rate", "goal_yaw", "cruise_speed", "climb_speed", "descend_speed"):
            self.setpoint[field] = np.nan
        self._mix = np.zeros((self.count, 4, MAX_ROTORS))
        self.rotors = np.zeros(self.count, np.int64)
        for i, layout in enumerate(layouts):
            rotors = len(layout.positions)
            self._mix[i, :, :rotors] = mixing_matrix(layout.positions, layout.moment_ratios).T
            self.rotors[i] = rotors
        self._work = np.zeros((2, N_STATES))

    def rotor_count(self, index: int) -> int:
        """Return how many rotors vehicle ``index`` has."""
        return int(self.rotors[index])

    def start_control(self) -> None:
        """Take over what the parameters fix at start: the hover thrust."""
        self.control["hover_thrust"] = self.params["mpc_thr_hover"]

    def step(self) -> None:
        """Advance every vehicle by one step of ``STEP_US`` over the samples in ``sensors``."""
        self.time_us += STEP_US
        step_all(
            self.sensors,
            self.estimator,
            self.setpoint,
            self.control,
            self.params,
            self._mix,
            self.rotors,
            STEP_US * 1e-6,
            self._work,
        )
