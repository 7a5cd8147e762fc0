"""Inner loops of all vehicles at 250 Hz: estimator, flight task, control cascade, allocation and land detection.

Independent of ROS, MAVLink and mode logic. Sensor models write ``sensors`` before each step, commander and navigator
write ``setpoint``; the motor commands are in ``control["actuators"]``.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_autopilot.control.attitude_and_rate_control import attitude_control, rate_control
from xtdrone_autopilot.control.control_allocator import RotorLayout, allocate, mixing_matrix, to_motor_commands
from xtdrone_autopilot.control.hover_thrust import estimate_hover_thrust, reset_hover_thrust
from xtdrone_autopilot.control.land_detector import detect_landing
from xtdrone_autopilot.control.position_control import control_position, differentiate_velocity, update_takeoff
from xtdrone_autopilot.estimator.ekf import update as update_estimator
from xtdrone_autopilot.flight_tasks.flight_tasks import follow_resets, generate_setpoint
from xtdrone_autopilot.flight_tasks.tasks.stick_control import stick_attitude, stick_rates, update_throttle_limits
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.parameters.parameters import PARAMS
from xtdrone_autopilot.sensors import correct_samples, update_angular_velocity, update_vibration
from xtdrone_common.geodesy.projection import Datum
from xtdrone_common.rotation_kernels import rotate

from .logger.log_folder import LogFolder
from .state import (
    CONTROL,
    ESTIMATOR,
    FAILURES,
    MAX_ROTORS,
    N_STATES,
    SENSORS,
    SETPOINT,
    TAKEOFF_RAMPUP,
    TASK_ACRO,
    TASK_ATTITUDE,
    TASK_IDLE,
    TASK_MANUAL,
    TASK_RATES,
    MotorTest,
    records,
)

STEP_US = 4000  # PX4's SITL lockstep period
TASK_STEPS = 5  # steps per run of the flight task: 50 Hz
POSITION_STEPS = 3  # steps per run of position control: 83 Hz, the rate of PX4's position estimate
_MIXER_PERIOD_US = 20_000


@kernel
def _zero_thrust(c):
    """Set thrust and torque setpoints to 0 and reset the integrators."""
    for i in range(3):
        c.velocity_integral[i] = 0.0
        c.rate_integral[i] = 0.0
        c.sp_thrust_vector[i] = 0.0
        c.sp_rates[i] = 0.0
        c.sp_torque[i] = 0.0
    c.sp_thrust = 0.0


@kernel
def _stop_motors(c, p):
    """Stop the motors of a disarmed vehicle and reset its hover thrust."""
    _zero_thrust(c)
    for i in range(MAX_ROTORS):
        c.actuators[i] = 0.0
    reset_hover_thrust(c.hover, p)
    c.hover_thrust = p.mpc_thr_hover


@kernel
def _hold_on_ground(c, e):
    """Keep the motors of an armed vehicle on the ground idle, with the current attitude as setpoint."""
    _zero_thrust(c)
    for i in range(4):
        c.sp_q[i] = e.q[i]


@kernel
def _apply_commanded_rates(c, s, e, p):
    """Update c.sp_rates and c.sp_thrust by tasks that command body rates."""
    if s.task == TASK_ACRO:
        stick_rates(c, s, p)
    elif s.task == TASK_RATES:
        c.sp_thrust = min(max(s.thrust, 0.0), 1.0)
        for i in range(3):
            # an axis without a setpoint keeps its current rate
            c.sp_rates[i] = e.rates[i] if math.isnan(s.rates[i]) else s.rates[i]


@kernel
def _control_attitude(c, s, e, p, dt):
    """Update c.sp_rates from the attitude setpoint, and c.sp_thrust for tasks without a position loop."""
    if s.task == TASK_ATTITUDE:
        c.sp_thrust = min(max(s.thrust, 0.0), 1.0)
        for i in range(4):
            c.sp_q[i] = s.attitude_q[i]
        c.sp_yaw_rate = s.rates[2]
        attitude_control(c, e, p)
    elif s.task == TASK_MANUAL:
        stick_attitude(c, s, e, p, dt)
        attitude_control(c, e, p)
    elif s.task != TASK_ACRO and s.task != TASK_RATES:
        attitude_control(c, e, p)
        return
    x, y, z = rotate(e.q, 0.0, 0.0, -c.sp_thrust)
    c.sp_thrust_vector[0], c.sp_thrust_vector[1], c.sp_thrust_vector[2] = x, y, z


@kernel
def _controls_climb_rate(task):
    return task != TASK_MANUAL and task != TASK_ACRO and task != TASK_ATTITUDE and task != TASK_RATES


@kernel
def _run_slow_loops(c, s, e, p, dt, climb_controlled):
    """Run the flight task at 50 Hz and position control at 83 Hz, the rates of PX4."""
    if c.tick % TASK_STEPS == 0 or s.task_changed:
        generate_setpoint(c, s, e, p, dt * TASK_STEPS)
    if c.tick % POSITION_STEPS != 0:
        return
    slow = dt * POSITION_STEPS
    differentiate_velocity(c, e, p, slow)
    wants_takeoff = c.want_takeoff == 1 and s.task != TASK_IDLE
    update_takeoff(c.takeoff, c, s.armed, p, wants_takeoff, s.task != TASK_IDLE and not climb_controlled)
    if not s.armed:
        return
    if climb_controlled and s.task != TASK_IDLE:
        control_position(c, e, p, slow)
    if not c.landing.landed:
        estimate_hover_thrust(c.hover, e, p, -c.sp_thrust_vector[2], slow)


@kernel
def _is_idle(c, s):
    return s.task == TASK_IDLE or c.takeoff.state < TAKEOFF_RAMPUP


@kernel
def _drive_motors(e, s, c, p, mix, unmix, rotors, dt):
    """Run rate control and allocation on this step's rates and the setpoints of the previous step."""
    if not s.armed:
        _stop_motors(c, p)
    elif _is_idle(c, s):
        _zero_thrust(c)
        allocate(c, mix, unmix, rotors, 0, int(p.ca_method))
    else:
        _apply_commanded_rates(c, s, e, p)
        rate_control(c, e, p, dt, not (c.landing.landed or c.landing.maybe_landed))
        allocate(c, mix, unmix, rotors, int(p.mc_airmode), int(p.ca_method))
        to_motor_commands(c, rotors, p.thr_mdl_fac)


@kernel
def _control_vehicle(sensors, e, s, c, p, dt):
    """Run flight task, position control and attitude control, whose setpoints act in the next step."""
    climb_controlled = _controls_climb_rate(s.task)
    c.armed_time = c.armed_time + dt if s.armed else 0.0
    follow_resets(c.path, c.last_velocity, c.resets_seen, e.resets, e.shifts)
    update_throttle_limits(c, p, s.armed, dt)
    if s.armed and not _is_idle(c, s):
        _control_attitude(c, s, e, p, dt)
    _run_slow_loops(c, s, e, p, dt, climb_controlled)
    c.tick += 1
    if s.armed and _is_idle(c, s):
        _hold_on_ground(c, e)
    if c.landing.landed:
        c.ground_z = e.position[2]
    detect_landing(c.landing, c, s, e, sensors, p, dt, climb_controlled)


@kernel
def step_vehicle(sensors, estimator, setpoint, control, params, mix, unmix, rotors, dt, work):
    """Advance one vehicle by one step; see ``step_all``. Before its first sample it does nothing.

    The order is PX4's: each gyro sample first runs rate control and allocation (work queue rate_ctrl), with the rate
    setpoint of the previous step; then the estimator publishes the attitude, on which attitude control runs, and last
    the position for position control (EKF2.cpp, nav_and_controllers). So a new attitude setpoint acts two steps later.
    """
    if sensors.time_us == 0:
        return
    correct_samples(sensors, params.correction)
    update_vibration(estimator.vibration, sensors, dt)
    if estimator.initialised:
        if not sensors.imu_missing:
            update_angular_velocity(estimator, sensors, params, dt)
        _drive_motors(estimator, setpoint, control, params, mix, unmix, rotors, dt)
    estimator.in_air = not control.landing.landed
    update_estimator(estimator, sensors, params, dt, work)
    if estimator.initialised:
        _control_vehicle(sensors, estimator, setpoint, control, params, dt)


@kernel
def step_all(sensors, estimator, setpoint, control, params, mix, unmix, rotors, dt, work):
    """Advance every vehicle by one step.

    Args:
        sensors, estimator, setpoint, control, params: record arrays of ``state`` and ``parameters``, shape (n,).
        mix: (n, 4, MAX_ROTORS) mixers, see ``control_allocator.allocate``.
        unmix: (n, 4, MAX_ROTORS) pseudo-inverses of the mixers.
        rotors: (n,) rotor counts.
        dt: length of the step, s.
        work: (2, N_STATES) scratch.
    """
    for i in range(sensors.shape[0]):
        step_vehicle(
            sensors[i], estimator[i], setpoint[i], control[i], params[i], mix[i], unmix[i], rotors[i], dt, work
        )  # fmt: skip


class Autopilot:
    """Records and inner loops of ``count`` vehicles.

    Attributes:
        sensors, estimator, setpoint, control, failures, params: record arrays of ``state`` and ``parameters``, shape
            (count,).
        rotors: number of rotors of each vehicle, shape (count,).
        mix, unmix: mixers and their pseudo-inverses, shape (count, 4, MAX_ROTORS), without the rotors of
            ``failed_rotors``, shape (count,), bit i for rotor i.
        time_us: simulated time, microseconds, of the last step.
        logs: log folder of each vehicle; empty without logging.
        motor_tests: running motor tests by index of the vehicle.
    """

    def __init__(self, layouts: Sequence[RotorLayout], datum: Datum | None, *, datum_known: bool = False) -> None:
        """Create the records of ``len(layouts)`` vehicles.

        Args:
            layouts: one rotor layout per vehicle.
            datum: common origin of the local frames; with None each vehicle's origin is its first GPS fix.
            datum_known: whether the vehicles know the datum from the start; otherwise, as with PX4, they have no global
                position before a GPS fix or SET_GPS_GLOBAL_ORIGIN.
        """
        self.count = len(layouts)
        self.time_us = 0
        self.logs: Sequence[LogFolder] = ()
        self.motor_tests: dict[int, MotorTest] = {}
        self.sensors = records(SENSORS, self.count)
        self.estimator = records(ESTIMATOR, self.count)
        self.setpoint = records(SETPOINT, self.count)
        self.control = records(CONTROL, self.count)
        self.failures = records(FAILURES, self.count)
        self.params = records(PARAMS, self.count)
        self._datum = datum
        self._datum_known = datum_known
        self._initialise_records(slice(None))
        self._layouts = list(layouts)
        self.failed_rotors = np.zeros(self.count, np.int32)
        self.mix = np.zeros((self.count, 4, MAX_ROTORS))
        self.unmix = np.zeros((self.count, 4, MAX_ROTORS))
        self.rotors = np.array([len(layout.positions) for layout in layouts], np.int64)
        self._geometry = np.zeros(self.count, np.int64)  # changes of the rotors' geometry that the mixers follow
        for i, layout in enumerate(layouts):
            self._set_mixer(i, layout)
        self._work = np.zeros((2, N_STATES))

    def _initialise_records(self, which: slice) -> None:
        """Set the initial values other than 0 in the records of the vehicles ``which``."""
        self.estimator["q"][which, 0] = 1.0
        self.control["landing"]["landed"][which] = 1
        self.control["sp_q"][which, 0] = 1.0
        if self._datum is not None:
            origin = self.estimator["origin"]
            origin["lat"][which] = self._datum.latitude
            origin["lon"][which] = self._datum.longitude
            origin["alt"][which] = self._datum.altitude
            origin["preset"][which] = 1
            origin["set"][which] = self._datum_known
        for field in ("position", "velocity", "acceleration", "goal_position", "onward_position"):
            self.setpoint[field][which] = np.nan
        for field in ("yaw", "yaw_rate", "goal_yaw", "cruise_speed", "climb_speed", "descend_speed"):
            self.setpoint[field][which] = np.nan
        self.setpoint["goal_radius"][which] = np.nan
        for field in ("task_position", "task_velocity", "task_acceleration", "task_yaw", "leg_goal", "leg_onward"):
            self.control[field][which] = np.nan

    def reboot(self, index: int) -> None:
        """Reset the records of vehicle ``index`` except sensors and parameters."""
        which = slice(index, index + 1)
        self.motor_tests.pop(index, None)
        for record in (self.estimator, self.setpoint, self.control, self.failures):
            record[which] = np.zeros(1, record.dtype)
        self._initialise_records(which)
        self.start_control(which)

    def replace(self, index: int, layout: RotorLayout) -> None:
        """Prepare the records of vehicle ``index`` for another vehicle that has not received a sample yet.

        Args:
            index: Index of the vehicle; its ``params`` are already set.
            layout: Rotors of the vehicle.
        """
        self._layouts[index] = layout
        self.failed_rotors[index] = 0
        self._geometry[index] = 0
        self._set_mixer(index, layout)
        self.sensors[index] = np.zeros(1, SENSORS)[0]
        self.reboot(index)

    def rotor_count(self, index: int) -> int:
        """Return the number of rotors of vehicle ``index``."""
        return int(self.rotors[index])

    def _set_mixer(self, i: int, layout: RotorLayout) -> None:
        """Compute the mixer of vehicle ``i`` for its working rotors.

        Raises:
            ValueError: see ``mixing_matrix``.
        """
        mix = mixing_matrix(layout, int(self.failed_rotors[i]))
        count = len(layout.positions)
        self.rotors[i] = count
        self.mix[i] = self.unmix[i] = 0.0
        self.mix[i, :, :count] = mix.T
        self.unmix[i, :, :count] = np.linalg.pinv(mix)

    def _layout(self, i: int) -> RotorLayout:
        """Return the rotors of vehicle ``i`` by its parameters, or its own if these describe none."""
        rotors = self.params["rotors"][i]
        count = int(rotors["count"])
        if count == 0:
            return self._layouts[i]
        return RotorLayout(
            *(rotors[field][:count].copy() for field in ("positions", "moment_ratios", "axes", "thrusts"))
        )

    def update_mixers(self) -> None:
        """Recompute the mixers of vehicles whose failed rotors or, while disarmed, whose CA_ROTOR* have changed.

        Rotors that cannot fly, as between two changes of parameters that belong together, leave the mixer as it is.
        """
        failed, changes = self.setpoint["failed_rotors"], self.params["rotors"]["changes"]
        moved = (changes != self._geometry) & (self.setpoint["armed"] == 0)
        for i in np.flatnonzero(moved | (failed != self.failed_rotors)):
            self.failed_rotors[i] = failed[i]
            self._geometry[i] = changes[i]
            with contextlib.suppress(ValueError):
                self._set_mixer(i, self._layout(i))

    def start_control(self, which: slice = slice(None)) -> None:
        """Initialise hover thrust and tilt limit of the vehicles ``which`` from their parameters."""
        self.control["hover_thrust"][which] = self.params["mpc_thr_hover"][which]
        self.control["hover"]["estimate"][which] = self.params["mpc_thr_hover"][which]
        self.control["tilt_limit"][which] = np.radians(self.params["mpc_tiltmax_lnd"][which])

    def step(self) -> None:
        """Advance every vehicle by ``STEP_US`` with the samples in ``sensors``."""
        self.time_us += STEP_US
        if self.time_us % _MIXER_PERIOD_US == 0:
            self.update_mixers()
        step_all(
            self.sensors,
            self.estimator,
            self.setpoint,
            self.control,
            self.params,
            self.mix,
            self.unmix,
            self.rotors,
            STEP_US * 1e-6,
            self._work,
        )
        if self.motor_tests:
            self._run_motor_tests()

    def _run_motor_tests(self) -> None:
        for index, test in list(self.motor_tests.items()):
            if self.setpoint["armed"][index] or self.time_us > test.end_us:
                self.end_motor_test(index)
            else:
                self.control["actuators"][index] = np.nan_to_num(test.outputs)

    def end_motor_test(self, index: int) -> None:
        """Stop the motors of vehicle ``index`` that run for a test, unless the vehicle is armed."""
        if self.motor_tests.pop(index, None) is not None and not self.setpoint["armed"][index]:
            self.control["actuators"][index] = 0.0  # the kernel does the same, but only once the estimator has started

    def motor_inputs(self) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Return the motor commands, shape (n, MAX_ROTORS), and which vehicles' motors are powered, shape (n,).

        Commands are 0..1; NaN, which occurs in motor tests only, stops a motor of a powered vehicle.
        """
        commands, powered = self.control["actuators"], self.setpoint["armed"]
        if not self.motor_tests:
            return commands, powered
        commands, powered = commands.copy(), powered.copy()
        for index, test in self.motor_tests.items():
            if not powered[index]:
                commands[index], powered[index] = test.outputs, 1
        return commands, powered
