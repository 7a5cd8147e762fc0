"""Control kernels against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_autopilot.autopilot import Autopilot
from xtdrone_autopilot.control import attitude_and_rate_control, control_allocator, position_control
from xtdrone_autopilot.control.control_allocator import RotorLayout
from xtdrone_autopilot.parameters.derived_records import geometry_parameters
from xtdrone_autopilot.parameters.parameters import PARAMS, Parameters
from xtdrone_autopilot.sensors import correct_samples, update_angular_velocity
from xtdrone_autopilot.state import CONTROL, ESTIMATOR, MAX_ROTORS, SENSORS, TAKEOFF_FLIGHT, TASK_ATTITUDE, TASK_RATES
from xtdrone_common import rotation_kernels as rotation

IRIS = np.array([[0.13, 0.22, -0.023], [-0.13, -0.20, -0.023], [0.13, -0.22, -0.023], [-0.13, 0.20, -0.023]])
MOMENTS = 0.06 * np.array([1.0, 1.0, -1.0, -1.0])


@pytest.fixture
def parts():
    control, estimate, params = np.zeros(1, CONTROL), np.zeros(1, ESTIMATOR), np.zeros(1, PARAMS)
    estimate["q"][:, 0] = 1.0
    control["hover_thrust"] = 0.5
    Parameters({}).write_to(params[0])
    return control[0], estimate[0], params[0]


def allocate(torque, thrust, positions=IRIS, moments=MOMENTS, failed=0, airmode=0, method=2):
    control = np.zeros(1, CONTROL)
    control["sp_torque"] = torque
    control["sp_thrust"] = thrust
    count = len(positions)
    mix, unmix = np.zeros((4, MAX_ROTORS)), np.zeros((4, MAX_ROTORS))
    mixer = control_allocator.mixing_matrix(RotorLayout(positions, moments), failed)
    mix[:, :count], unmix[:, :count] = mixer.T, np.linalg.pinv(mixer)
    control_allocator.allocate(control[0], mix, unmix, count, airmode, method)
    return control[0]


def produced(control, positions=IRIS, moments=MOMENTS):
    """Return roll, pitch and yaw torque and the thrust of motor commands, the thrust in units of its command."""
    return control_allocator.effectiveness(RotorLayout(positions, moments)) @ control["actuators"][: len(positions)]


def clear(c):
    for field in ("sp_position", "sp_velocity", "sp_acceleration"):
        c[field] = math.nan


def test_collective_thrust_goes_to_all_motors():
    np.testing.assert_allclose(allocate((0, 0, 0), 0.6)["actuators"][:4], 0.6, atol=0.03)


@pytest.mark.parametrize(("torque", "raised"), [((0.1, 0, 0), {1, 2}), ((0, 0.1, 0), {0, 2}), ((0, 0, 0.1), {0, 1})])
def test_each_axis_raises_the_right_motors(torque, raised):
    """Roll right speeds up the left motors, pitch up the front ones, yaw right the counter-clockwise ones."""
    u = allocate(torque, 0.5)["actuators"][:4]
    assert set(np.flatnonzero(u > 0.505)) == raised


def test_torques_are_produced_exactly_without_saturation():
    mix = control_allocator.mixing_matrix(RotorLayout(IRIS, MOMENTS))
    effectiveness = np.stack([-IRIS[:, 1], IRIS[:, 0], MOMENTS, np.ones(4)])
    product = effectiveness @ mix
    assert np.all(np.abs(product - np.diag(np.diag(product))) < 1e-9)


def test_saturation_gives_up_yaw_before_roll():
    mix = control_allocator.mixing_matrix(RotorLayout(IRIS, MOMENTS))
    control = allocate((0.2, 0.0, 0.9), 0.8)
    u = control["actuators"][:4]
    assert u.max() <= 1.0
    assert u.min() >= 0.0
    torque = np.linalg.lstsq(mix, u, rcond=None)[0]
    assert torque[0] == pytest.approx(0.2, rel=0.1)
    assert 0.0 < torque[2] < 0.5
    assert control["saturation_pos"][2] == 1


@pytest.mark.parametrize("factor", [0.0, 0.3, 1.0])
def test_motor_commands_by_the_thrust_model(factor):
    """THR_MDL_FAC: thrust = factor u^2 + (1 - factor) u."""
    control = np.zeros(1, CONTROL)[0]
    thrusts = np.linspace(0.0, 1.0, MAX_ROTORS)
    control["actuators"] = thrusts
    control_allocator.to_motor_commands(control, MAX_ROTORS, factor)
    u = control["actuators"]
    np.testing.assert_allclose(factor * u**2 + (1.0 - factor) * u, thrusts, atol=1e-12)


@pytest.mark.parametrize("count", [3, MAX_ROTORS + 1])
def test_rotor_counts_are_limited(count):
    with pytest.raises(ValueError, match=str(count)):
        control_allocator.mixing_matrix(RotorLayout(np.ones((count, 3)), np.ones(count)))


def test_uncontrollable_rotors_are_rejected():
    with pytest.raises(ValueError, match="cannot control all four axes"):
        control_allocator.mixing_matrix(RotorLayout(IRIS, np.zeros(4)))


def test_hover_results_in_level_attitude_and_hover_thrust(parts):
    c, e, p = parts
    clear(c)
    c["sp_position"] = 0.0
    position_control.position_loop(c, e, p, 3.0, 1.5)
    position_control.velocity_loop(c, e, p, 0.012, math.radians(45), 0.12)
    position_control.thrust_to_attitude(c, e)
    assert c["sp_thrust"] == pytest.approx(0.5)
    np.testing.assert_allclose(c["sp_q"], (1.0, 0.0, 0.0, 0.0), atol=1e-12)


def test_tilt_is_limited_and_points_at_the_acceleration(parts):
    c, e, p = parts
    clear(c)
    c["sp_acceleration"] = (50.0, 0.0, 0.0)
    c["sp_velocity"][2] = 0.0
    position_control.velocity_loop(c, e, p, 0.012, math.radians(30), 0.12)
    position_control.thrust_to_attitude(c, e)
    z = rotation.rotate(c["sp_q"], 0.0, 0.0, 1.0)
    assert math.degrees(math.acos(z[2])) == pytest.approx(30.0, abs=1e-6)
    assert -z[0] > 0.0  # the thrust leans north


def test_horizontal_limit_keeps_the_first_vector_s_priority():
    x, y = position_control._limit_horizontal(3.0, 0.0, 0.0, 10.0, 5.0)
    assert x == pytest.approx(3.0)
    assert math.hypot(x, y) == pytest.approx(5.0)


@pytest.mark.parametrize("angle", [0.05, -0.3, 1.0])
def test_small_heading_error_gives_yaw_gain(parts, angle):
    c, e, p = parts
    c["sp_q"] = rotation.from_euler(0.0, 0.0, angle)
    c["sp_yaw_rate"] = 0.0
    attitude_and_rate_control.attitude_control(c, e, p)
    weight = p["mc_yaw_weight"]
    expected = 2.0 * math.sin(0.5 * weight * angle) * p["mc_yaw_p"] / weight
    np.testing.assert_allclose(c["sp_rates"], (0.0, 0.0, expected), atol=1e-6)


def test_roll_error_gives_roll_gain_at_any_heading(parts):
    c, e, p = parts
    e["q"] = rotation.from_euler(0.0, 0.0, 2.0)
    c["sp_q"] = rotation.from_euler(0.1, 0.0, 2.0)
    c["sp_yaw_rate"] = 0.0
    attitude_and_rate_control.attitude_control(c, e, p)
    np.testing.assert_allclose(c["sp_rates"], (2.0 * math.sin(0.05) * p["mc_roll_p"], 0.0, 0.0), atol=1e-6)


def test_from_axes_inverts_rotation():
    rng = np.random.default_rng(3)
    for _ in range(200):
        q = rng.standard_normal(4)
        q /= np.linalg.norm(q)
        x, y, z = (rotation.rotate(q, *axis) for axis in np.eye(3))
        again = np.array(rotation.from_axes(x, y, z))
        assert abs(abs(np.dot(again, q)) - 1.0) < 1e-9


def hexacopter():
    angles = np.radians([30.0, 90.0, 150.0, 210.0, 270.0, 330.0])
    places = 0.3 * np.stack([np.cos(angles), np.sin(angles), np.zeros(6)], axis=1)
    return places, 0.05 * np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])


@pytest.mark.parametrize("rotor", range(6))
def test_five_rotors_do_the_work_of_six(rotor):
    places, moments = hexacopter()
    whole = produced(allocate((0.02, -0.01, 0.0), 0.4, places, moments), places, moments)
    control = allocate((0.02, -0.01, 0.0), 0.4, places, moments, failed=1 << rotor)
    assert control["actuators"][rotor] == 0.0
    given = produced(control, places, moments)
    assert given[3] > 0.75 * whole[3]
    assert np.dot(given[:2], whole[:2]) > 0.7 * np.linalg.norm(given[:2]) * np.linalg.norm(whole[:2])
    assert 0.4 < np.linalg.norm(given[:2]) / np.linalg.norm(whole[:2]) < 2.5


def test_an_octocopter_keeps_all_axes_without_a_rotor():
    angles = np.radians(22.5 + 45.0 * np.arange(8))
    places = 0.3 * np.stack([np.cos(angles), np.sin(angles), np.zeros(8)], axis=1)
    moments = 0.05 * np.array([1.0, 1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0])
    given = produced(allocate((0.0, 0.0, 0.05), 0.4, places, moments, failed=1), places, moments)
    assert given[2] > 0.0
    np.testing.assert_allclose(given[:2], 0.0, atol=1e-9)


@pytest.mark.parametrize("rotor", range(4))
def test_a_quadrotor_without_a_rotor_gives_up_yaw_and_remains_level(rotor):
    control = allocate((0.0, 0.0, 0.3), 0.4, failed=1 << rotor)
    assert control["actuators"][rotor] == 0.0
    roll, pitch, _, thrust = produced(control)
    assert thrust > 0.5
    assert abs(roll) < 0.02 * thrust  # with a lever of 0.2
    assert abs(pitch) < 0.02 * thrust


def test_saturation_flags_name_the_unallocated_axes():
    control = allocate((0.0, 0.0, -2.0), 0.5)
    assert control["saturation_neg"].tolist() == [0, 0, 1]
    assert control["saturation_pos"].tolist() == [0, 0, 0]
    assert not allocate((0.05, 0.05, 0.05), 0.5)["saturation_pos"].any()


def test_air_mode_raises_thrust_to_keep_roll():
    without = produced(allocate((0.3, 0.0, 0.0), 0.05))
    airborne = produced(allocate((0.3, 0.0, 0.0), 0.05, airmode=1))
    assert airborne[3] > 2.0 * without[3]
    assert airborne[0] > 2.0 * without[0]


def test_velocity_limit_of_the_take_off_ramp_holds_over_the_sink_limit(parts):
    c, e, p = parts
    clear(c)
    c["sp_velocity"] = (0.0, 0.0, -1.0)
    position_control.position_loop(c, e, p, -2.4, 1.5)
    assert c["sp_velocity"][2] == pytest.approx(2.4)


def test_position_error_has_priority_over_the_feed_forward(parts):
    c, e, p = parts
    clear(c)
    c["sp_position"] = (20.0, 0.0, 0.0)
    c["sp_velocity"] = (0.0, 12.0, 0.0)
    position_control.position_loop(c, e, p, 3.0, 1.5)
    assert c["sp_velocity"][0] == pytest.approx(p["mpc_xy_vel_max"])
    assert c["sp_velocity"][1] == pytest.approx(0.0, abs=1e-9)


def test_a_new_hover_thrust_changes_nothing_at_once(parts):
    c, e, p = parts
    thrusts = []
    for estimate in (0.5, 0.7):
        position_control.use_hover_thrust(c, estimate)
        clear(c)
        c["sp_velocity"] = (0.0, 0.0, -0.4)
        before = c["velocity_integral"].copy()
        position_control.velocity_loop(c, e, p, 1e-9, math.radians(45), 0.12)
        c["velocity_integral"] = before
        thrusts.append(c["sp_thrust_vector"][2])
    assert thrusts[0] == pytest.approx(thrusts[1])


@pytest.mark.parametrize("frequency", [2.0, 20.0, 60.0])
def test_rates_are_filtered_as_by_a_butterworth_of_second_order(parts, frequency):
    """PX4's LowPassFilter2p: 1 / sqrt(1 + (w / w_c)^4), where w = tan(pi f dt) of the bilinear transform."""
    _, e, p = parts
    s, dt = np.zeros(1, SENSORS)[0], 0.004
    times = dt * np.arange(1000)
    rates = []
    for gyro in np.cos(2.0 * math.pi * frequency * times):
        s["gyro"] = gyro
        update_angular_velocity(e, s, p, dt)
        rates.append(e["rates"][0])
    wave = np.exp(-2j * math.pi * frequency * times[500:])
    gain = 2.0 * abs(np.mean(np.array(rates[500:]) * wave))
    warped = math.tan(math.pi * frequency * dt) / math.tan(math.pi * p["imu_gyro_cutoff"] * dt)
    assert gain == pytest.approx(1.0 / math.sqrt(1.0 + warped**4), rel=0.01)


def test_rates_without_a_cutoff_are_the_gyro_s(parts):
    _, e, p = parts
    s = np.zeros(1, SENSORS)[0]
    p["imu_gyro_cutoff"] = 0.0
    s["gyro"], e["gyro_bias"] = (0.1, -0.2, 0.3), 0.01
    update_angular_velocity(e, s, p, 0.004)
    np.testing.assert_allclose(e["rates"], (0.09, -0.21, 0.29))


def test_derivative_of_the_velocity_is_low_passed_and_survives_resets(parts):
    """PX4's BlockDerivative: after n runs of a ramp 1 - (1 + 2 pi f dt)^-n of its slope."""
    c, e, p = parts
    dt, slope = 0.012, np.array([1.0, -2.0, 0.5])
    for _ in range(10):
        e["velocity"] += slope * dt
        position_control.differentiate_velocity(c, e, p, dt)
    share = 1.0 - (1.0 + 2.0 * math.pi * p["mpc_veld_lp"] * dt) ** -10
    np.testing.assert_allclose(c["velocity_dot"], share * slope)
    c["last_velocity"], e["velocity"] = math.nan, 50.0
    position_control.differentiate_velocity(c, e, p, dt)
    assert np.all(np.abs(c["velocity_dot"]) < 2.0)


def flying(task):
    """Return an autopilot at rest in the air with the ``task``."""
    autopilot = Autopilot([RotorLayout(IRIS, MOMENTS)], None)
    Parameters({}).write_to(autopilot.params[0])
    autopilot.sensors["accel"], autopilot.sensors["time_us"] = (0.0, 0.0, -9.80665), 4000
    autopilot.estimator["initialised"] = 1
    autopilot.control["landing"]["landed"] = 0
    autopilot.control["takeoff"]["state"] = TAKEOFF_FLIGHT
    goal = autopilot.setpoint
    goal["armed"], goal["task"], goal["thrust"], goal["attitude_q"] = 1, task, 0.5, (1.0, 0.0, 0.0, 0.0)
    for _ in range(3):
        autopilot.step()
    return autopilot


@pytest.mark.parametrize(("task", "delay"), [(TASK_RATES, 0), (TASK_ATTITUDE, 1)])
def test_setpoints_act_in_px4_s_order(task, delay):
    """Commanded rates act at once; an attitude one step later, as rate control runs on each gyro sample first."""
    autopilot = flying(task)
    before = autopilot.control["actuators"].copy()
    autopilot.setpoint["rates"] = (0.5, 0.0, 0.0)
    autopilot.setpoint["attitude_q"] = rotation.from_euler(0.1, 0.0, 0.0)
    changed = []
    for _ in range(3):
        autopilot.step()
        changed.append(not np.allclose(autopilot.control["actuators"], before))
    assert changed.index(True) == delay


def test_rotors_by_parameter_act_while_disarmed():
    autopilot = Autopilot([RotorLayout(IRIS, MOMENTS)], None)
    parameters = Parameters(geometry_parameters(IRIS, MOMENTS))
    parameters.write_to(autopilot.params[0])
    own = autopilot.mix.copy()
    autopilot.update_mixers()
    np.testing.assert_array_equal(autopilot.mix, own)
    parameters.set("CA_ROTOR0_PX", 0.3)
    autopilot.setpoint["armed"] = 1
    autopilot.update_mixers()
    np.testing.assert_array_equal(autopilot.mix, own)
    autopilot.setpoint["armed"] = 0
    autopilot.update_mixers()
    assert not np.array_equal(autopilot.mix, own)
    for name in ("CA_ROTOR0_PX", "CA_ROTOR1_PX"):  # no longer controllable: the last mixer stays
        parameters.set(name, 0.0)
    for rotor in range(4):
        parameters.set(f"CA_ROTOR{rotor}_KM", 0.0)
    last = autopilot.mix.copy()
    autopilot.update_mixers()
    np.testing.assert_array_equal(autopilot.mix, last)
    parameters.set("CA_ROTOR_COUNT", 0)
    autopilot.update_mixers()
    np.testing.assert_array_equal(autopilot.mix, own)


def test_samples_are_corrected_by_calibration_and_mount():
    sensors, params = np.zeros(1, SENSORS), np.zeros(1, PARAMS)
    changes = {"CAL_GYRO0_XOFF": 0.1, "CAL_ACC0_ZSCALE": 0.5, "CAL_MAG0_XODIAG": 0.25, "SENS_BOARD_ROT": 2}
    Parameters(changes).write_to(params[0])
    sensors["gyro"], sensors["accel"], sensors["mag"] = (0.3, 0.0, 0.2), (1.0, 2.0, -10.0), (0.2, 0.4, 0.0)
    sensors["mag_fresh"] = 1
    correct_samples(sensors[0], params["correction"][0])
    np.testing.assert_allclose(sensors["gyro"][0], (0.0, 0.2, 0.2), atol=1e-12)  # turned by 90 deg about down
    np.testing.assert_allclose(sensors["accel"][0], (-2.0, 1.0, -5.0), atol=1e-12)
    np.testing.assert_allclose(sensors["mag"][0], (-0.45, 0.3, 0.0), atol=1e-12)
