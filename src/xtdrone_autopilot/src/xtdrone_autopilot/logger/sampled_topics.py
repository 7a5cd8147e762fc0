"""Topics sampled at a fixed rate, each filled from the autopilot's records of all vehicles together.

The logger stores copies of the records at successive times. The ``fill`` function of a topic converts them to the
fields of its messages with a few numpy operations over all vehicles and times. As in PX4: local NED, body FRD,
quaternions (w, x, y, z), SI units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from xtdrone_autopilot.state import HEIGHT_BARO, HEIGHT_GPS, HEIGHT_RANGE, HEIGHT_VISION, MAX_ROTORS
from xtdrone_common.geodesy import projection
from xtdrone_common.rotation import to_eulers, yaws_of

EPOCH_US = 1_577_836_800_000_000  # 2020-01-01 00:00 UTC, simulated time 0, as in telemetry

_NAN = np.nan
_PI = np.pi
_GAS_CONSTANT = 287.1  # J/(kg K), dry air
_KELVIN = 273.15
_DISARMED_PULSE, _MIN_PULSE, _PULSE_RANGE = 900.0, 1000.0, 1000.0  # us, as in SERVO_OUTPUT_RAW

# one device of each kind, with nonzero ids, because PX4 uses 0 for "no device"
_IMU_DEVICE, _MAG_DEVICE, _BARO_DEVICE, _GPS_DEVICE = 1310988, 197388, 6620172, 11469044

# bits of control_mode_flags in estimator_status, in the order of the cs_* fields of estimator_status_flags
_CS_TILT_ALIGN, _CS_YAW_ALIGN, _CS_GPS, _CS_OPT_FLOW, _CS_MAG_HDG, _CS_IN_AIR = 0, 1, 2, 3, 4, 7
_CS_BARO_HGT, _CS_RNG_HGT, _CS_GPS_HGT, _CS_EV_POS, _CS_EV_YAW, _CS_EV_HGT = 9, 10, 11, 12, 13, 14
_CS_MAG_DISTURBED, _CS_MAG_FAULT, _CS_EV_VEL, _CS_DEAD_RECKONING = 16, 18, 24, 29
_MAGNETIC_FAULT = 4  # of ESTIMATOR.fault_flags

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Samples:
    """Records of all vehicles at several times; arrays of shape (times, vehicles) unless noted.

    Attributes:
        time_us: (times,) simulated time, microseconds.
        sensors: ``state.SENSORS``.
        estimator: ``state.ESTIMATOR`` without its covariance.
        variances: (times, vehicles, states), diagonal of the covariance.
        setpoint: ``state.SETPOINT``.
        control: ``state.CONTROL``.
        rotors: (vehicles,) number of rotors.
    """

    time_us: NDArray[np.int64]
    sensors: np.ndarray
    estimator: np.ndarray
    variances: NDArray[np.float64]
    setpoint: np.ndarray
    control: np.ndarray
    rotors: NDArray[np.int64]

    @cached_property
    def heading(self) -> Array:
        """Estimated heading, rad, -pi..pi."""
        return yaws_of(self.estimator["q"])

    @cached_property
    def horizontal_accuracy(self) -> Array:
        """Standard deviation of the horizontal position, m."""
        return _root(self.variances[..., 6] + self.variances[..., 7])

    @cached_property
    def vertical_accuracy(self) -> Array:
        """Standard deviation of the height, m."""
        return _root(self.variances[..., 8])

    @cached_property
    def coordinates(self) -> tuple[Array, Array]:
        """Estimated latitude and longitude, degrees."""
        e = self.estimator
        return reproject(e["position"][..., 0], e["position"][..., 1], e["origin"]["lat"], e["origin"]["lon"])


def _root(variance: Array) -> Array:
    return np.sqrt(np.maximum(variance, 0.0))


def reproject(north: Array, east: Array, latitude: Array, longitude: Array) -> tuple[Array, Array]:
    """Return latitude and longitude, degrees, of points ``north`` and ``east`` of an origin, m.

    Vectorised form of ``projection.reproject``.
    """
    x, y = north / projection.EARTH_RADIUS, east / projection.EARTH_RADIUS
    angle = np.hypot(x, y)
    share = np.sinc(angle / _PI)  # sin(angle) / angle, 1 at the origin
    phi0 = np.radians(latitude)
    phi = np.arcsin(np.clip(np.cos(angle) * np.sin(phi0) + x * share * np.cos(phi0), -1.0, 1.0))
    turn = np.arctan2(y * share, np.cos(phi0) * np.cos(angle) - x * share * np.sin(phi0))
    return np.degrees(phi), longitude + np.degrees(turn)


Fill = Callable[[np.ndarray, Samples], None]


@dataclass(frozen=True)
class Topic:
    """Sampled topic.

    Attributes:
        name: PX4's name of the topic.
        period_us: minimum interval between messages, microseconds; 0 for every step.
        fill: writes the variable fields of the messages. Arguments: message records of shape (times, vehicles), zero
            except for timestamps and ``constants``, and the samples.
        constants: fields with the same value in every message.
        fresh: field of ``SENSORS`` that marks a new sample; empty if every step has one.
    """

    name: str
    period_us: int
    fill: Fill
    constants: tuple[tuple[str, object], ...] = ()
    fresh: str = ""


TOPICS: list[Topic] = []


def _topic(name: str, period_ms: int, fresh: str = "", **constants: object) -> Callable[[Fill], Fill]:
    def add(fill: Fill) -> Fill:
        TOPICS.append(Topic(name, period_ms * 1000, fill, tuple(constants.items()), fresh))
        return fill

    return add


# sensors


@_topic("sensor_combined", 0, gyro_integral_dt=4000, accelerometer_integral_dt=4000)
def _sensor_combined(m: np.ndarray, s: Samples) -> None:
    m["gyro_rad"] = s.sensors["gyro"]
    m["accelerometer_m_s2"] = s.sensors["accel"]


@_topic("vehicle_magnetometer", 200, fresh="mag_fresh", device_id=_MAG_DEVICE)
def _magnetometer(m: np.ndarray, s: Samples) -> None:
    m["magnetometer_ga"] = s.sensors["mag"]


@_topic("vehicle_air_data", 200, fresh="baro_fresh", baro_device_id=_BARO_DEVICE)
def _air_data(m: np.ndarray, s: Samples) -> None:
    temperature = s.sensors["baro_temperature"]
    m["baro_alt_meter"] = s.sensors["baro_alt"]
    m["baro_temp_celcius"] = temperature
    m["baro_pressure_pa"] = s.sensors["baro_pressure"]
    m["rho"] = s.sensors["baro_pressure"] / (_GAS_CONSTANT * (temperature + _KELVIN))


def _gps(m: np.ndarray, s: Samples) -> None:
    gps = s.sensors
    velocity = gps["gps_vel"]
    m["lat"] = np.rint(gps["gps_lat"] * 1e7)
    m["lon"] = np.rint(gps["gps_lon"] * 1e7)
    m["alt"] = m["alt_ellipsoid"] = np.rint(gps["gps_alt"] * 1e3)
    m["s_variance_m_s"] = gps["gps_speed_accuracy"]
    m["fix_type"] = gps["gps_fix"]
    m["eph"] = gps["gps_eph"]
    m["epv"] = gps["gps_epv"]
    m["vel_m_s"] = np.hypot(velocity[..., 0], velocity[..., 1])
    m["vel_n_m_s"], m["vel_e_m_s"], m["vel_d_m_s"] = np.moveaxis(velocity, -1, 0)
    m["cog_rad"] = np.arctan2(velocity[..., 1], velocity[..., 0])
    m["vel_ned_valid"] = gps["gps_fix"] >= 3
    m["time_utc_usec"] = EPOCH_US + s.time_us[:, None]
    m["satellites_used"] = gps["gps_satellites"]


_GPS_CONSTANTS = {"device_id": _GPS_DEVICE, "heading": _NAN, "heading_offset": _NAN, "hdop": 0.7, "vdop": 1.1}
_topic("vehicle_gps_position", 100, fresh="gps_fresh", **_GPS_CONSTANTS)(_gps)
_topic("sensor_gps", 1000, fresh="gps_fresh", **_GPS_CONSTANTS)(_gps)


# estimates


@_topic("vehicle_attitude", 40)
def _attitude(m: np.ndarray, s: Samples) -> None:
    m["q"] = s.estimator["q"]
    half = 0.5 * s.estimator["shifts"]["heading"]  # resets affect the heading only
    m["delta_q_reset"][..., 0], m["delta_q_reset"][..., 3] = np.cos(half), np.sin(half)
    m["quat_reset_counter"] = s.estimator["resets"]["heading"] & 0xFF


@_topic("vehicle_angular_velocity", 20)
def _angular_velocity(m: np.ndarray, s: Samples) -> None:
    m["xyz"] = s.estimator["rates"]
    m["xyz_derivative"] = s.estimator["angular_acceleration"]


@_topic("vehicle_acceleration", 40)
def _acceleration(m: np.ndarray, s: Samples) -> None:
    m["xyz"] = s.sensors["accel"] - s.estimator["accel_bias"]


@_topic("vehicle_local_position", 100, dist_bottom=_NAN, vxy_max=_NAN, vz_max=_NAN, hagl_min=_NAN, hagl_max=_NAN)
def _local_position(m: np.ndarray, s: Samples) -> None:
    e = s.estimator
    m["xy_valid"] = m["v_xy_valid"] = e["position_valid"]
    m["z_valid"] = m["v_z_valid"] = e["altitude_valid"]
    m["x"], m["y"], m["z"] = np.moveaxis(e["position"], -1, 0)
    m["vx"], m["vy"], m["vz"] = np.moveaxis(e["velocity"], -1, 0)
    m["z_deriv"] = e["velocity"][..., 2]
    m["ax"], m["ay"], m["az"] = np.moveaxis(e["acceleration"], -1, 0)
    m["heading"] = s.heading
    m["heading_good_for_control"] = e["heading_aligned"] | e["vision_yaw_used"]
    for part in ("xy", "z", "vxy", "vz", "heading"):
        m[f"{part}_reset_counter"] = e["resets"][part] & 0xFF
        m[f"delta_{part}"] = e["shifts"][part]
    m["xy_global"] = m["z_global"] = e["origin"]["set"]
    m["ref_lat"], m["ref_lon"], m["ref_alt"] = e["origin"]["lat"], e["origin"]["lon"], e["origin"]["alt"]
    m["eph"], m["epv"] = s.horizontal_accuracy, s.vertical_accuracy
    m["evh"] = _root(s.variances[..., 3] + s.variances[..., 4])
    m["evv"] = _root(s.variances[..., 5])


@_topic("vehicle_global_position", 200, terrain_alt=_NAN)
def _global_position(m: np.ndarray, s: Samples) -> None:
    e = s.estimator
    m["lat"], m["lon"] = s.coordinates
    m["alt"] = m["alt_ellipsoid"] = e["origin"]["alt"] - e["position"][..., 2]
    m["lat_lon_reset_counter"] = e["resets"]["xy"] & 0xFF
    m["alt_reset_counter"] = e["resets"]["z"] & 0xFF
    m["eph"], m["epv"] = s.horizontal_accuracy, s.vertical_accuracy


def _control_flags(s: Samples) -> NDArray[np.int64]:
    e = s.estimator
    heights = e["height_used"]
    bits = (
        (_CS_TILT_ALIGN, e["initialised"]),
        (_CS_YAW_ALIGN, e["heading_aligned"] | e["vision_yaw_used"]),
        (_CS_GPS, e["gps_used"]),
        (_CS_OPT_FLOW, e["flow_used"]),
        (_CS_MAG_HDG, e["mag_used"]),
        (_CS_IN_AIR, s.control["landing"]["landed"] == 0),
        (_CS_BARO_HGT, heights[..., HEIGHT_BARO]),
        (_CS_RNG_HGT, heights[..., HEIGHT_RANGE]),
        (_CS_GPS_HGT, heights[..., HEIGHT_GPS]),
        (_CS_EV_POS, e["vision_position_used"]),
        (_CS_EV_YAW, e["vision_yaw_used"]),
        (_CS_EV_HGT, heights[..., HEIGHT_VISION]),
        (_CS_MAG_DISTURBED, (e["fault_flags"] & _MAGNETIC_FAULT != 0) & (e["mag_fault"] == 0)),
        (_CS_MAG_FAULT, e["mag_fault"]),
        (_CS_EV_VEL, e["vision_velocity_used"]),
        (_CS_DEAD_RECKONING, e["dead_reckoning"]),
    )
    flags = np.zeros(e.shape, np.int64)
    for bit, held in bits:
        flags |= (np.asarray(held) != 0).astype(np.int64) << bit
    return flags


@_topic(
    "estimator_status",
    200,
    accel_device_id=_IMU_DEVICE,
    gyro_device_id=_IMU_DEVICE,
    baro_device_id=_BARO_DEVICE,
    mag_device_id=_MAG_DEVICE,
)
def _estimator_status(m: np.ndarray, s: Samples) -> None:
    e = s.estimator
    m["control_mode_flags"] = _control_flags(s)
    m["pos_horiz_accuracy"], m["pos_vert_accuracy"] = s.horizontal_accuracy, s.vertical_accuracy
    for name in ("vel", "pos", "hgt", "mag"):
        m[f"{name}_test_ratio"] = _root(e["test_ratio"][name])
    m["hagl_test_ratio"] = _root(e["test_ratio"]["terrain"])
    failed = [(e["test_ratio"][name] > 1.0) << bit for name, bit in (("vel", 0), ("pos", 1), ("hgt", 2), ("mag", 6))]
    m["innovation_check_flags"] = sum(failed)
    m["solution_status_flags"] = e["flags"]
    parts = (("vel_ne", "vxy"), ("vel_d", "vz"), ("pos_ne", "xy"), ("pod_d", "z"), ("quat", "heading"))
    for name, part in parts:
        m[f"reset_count_{name}"] = e["resets"][part] & 0xFF
    m["mag_strength_gs"] = np.linalg.norm(s.sensors["mag"], axis=-1)


@_topic("estimator_status_flags", 1000)
def _estimator_status_flags(m: np.ndarray, s: Samples) -> None:
    flags = _control_flags(s)
    for bit, name in enumerate(name for name in m.dtype.names or () if name.startswith("cs_")):
        m[name] = flags >> bit & 1
    ratio = s.estimator["test_ratio"]
    m["reject_hor_vel"] = m["reject_ver_vel"] = ratio["vel"] > 1.0
    m["reject_hor_pos"] = ratio["pos"] > 1.0
    m["reject_ver_pos"] = ratio["hgt"] > 1.0
    m["reject_yaw"] = ratio["mag"] > 1.0
    m["reject_hagl"] = ratio["terrain"] > 1.0
    m["reject_optflow_x"] = m["reject_optflow_y"] = ratio["flow"] > 1.0


@_topic("estimator_innovations", 200)
def _innovations(m: np.ndarray, s: Samples) -> None:
    e = s.estimator
    innovation = e["innovation"]
    m["gps_hvel"], m["gps_vvel"] = innovation["vel"][..., :2], innovation["vel"][..., 2]
    m["gps_hpos"], m["gps_vpos"] = innovation["pos"][..., :2], innovation["pos"][..., 2]
    m["baro_vpos"] = innovation["hgt"]
    m["ev_hvel"], m["ev_vvel"] = innovation["vision_vel"][..., :2], innovation["vision_vel"][..., 2]
    m["ev_hpos"], m["ev_vpos"] = innovation["vision_pos"][..., :2], innovation["vision_pos"][..., 2]
    m["rng_vpos"] = innovation["range"]
    m["flow"] = innovation["flow"]
    m["heading"] = np.where(e["vision_yaw_used"], innovation["vision_yaw"], innovation["yaw"])


@_topic("estimator_innovation_test_ratios", 200)
def _test_ratios(m: np.ndarray, s: Samples) -> None:
    e = s.estimator
    ratio = e["test_ratio"]
    m["gps_hvel"][..., 0] = ratio["vel"]  # the ratio of a vector is its first element
    m["gps_hpos"][..., 0] = ratio["pos"]
    m["gps_vpos"], m["baro_vpos"] = ratio["gps_hgt"], ratio["baro"]
    m["ev_hvel"][..., 0], m["ev_hpos"][..., 0] = ratio["vision_vel"], ratio["vision_pos"]
    m["ev_vpos"], m["rng_vpos"] = ratio["vision_hgt"], ratio["range"]
    m["flow"][..., 0], m["hagl"] = ratio["flow"], ratio["terrain"]
    m["heading"] = np.where(e["vision_yaw_used"], ratio["vision_yaw"], ratio["mag"])


@_topic("estimator_states", 500, n_states=24)
def _states(m: np.ndarray, s: Samples) -> None:
    e = s.estimator
    parts = ("q", "velocity", "position", "gyro_bias", "accel_bias")
    first = 0
    for part in parts:
        size = e[part].shape[-1]
        m["states"][..., first : first + size] = e[part]
        first += size
    m["covariances"][..., :15] = s.variances[..., :15]


@_topic("hover_thrust_estimate", 100)
def _hover_thrust(m: np.ndarray, s: Samples) -> None:
    c = s.control
    m["hover_thrust"], m["hover_thrust_var"] = c["hover"]["estimate"], c["hover"]["variance"]
    m["accel_innov"], m["accel_innov_test_ratio"] = c["hover"]["residual"], c["hover"]["test_ratio"]
    m["accel_noise_var"] = c["hover"]["noise"]
    m["valid"] = c["hover"]["valid"]


@_topic("vehicle_land_detected", 100)
def _land_detected(m: np.ndarray, s: Samples) -> None:
    for name in ("freefall", "ground_contact", "maybe_landed", "landed"):
        m[name] = s.control["landing"][name]


# setpoints and actuators


@_topic("trajectory_setpoint", 200, jerk=_NAN)
def _trajectory_setpoint(m: np.ndarray, s: Samples) -> None:
    for name in ("position", "velocity", "acceleration"):
        m[name] = s.control[f"sp_{name}"]
    m["yaw"], m["yawspeed"] = s.control["sp_yaw"], s.control["sp_yaw_rate"]


@_topic("vehicle_local_position_setpoint", 100, jerk=_NAN)
def _local_position_setpoint(m: np.ndarray, s: Samples) -> None:
    c = s.control
    m["x"], m["y"], m["z"] = np.moveaxis(c["sp_position"], -1, 0)
    m["vx"], m["vy"], m["vz"] = np.moveaxis(c["sp_velocity"], -1, 0)
    m["acceleration"] = c["sp_acceleration"]
    m["thrust"] = c["sp_thrust_vector"]
    m["yaw"], m["yawspeed"] = c["sp_yaw"], c["sp_yaw_rate"]


@_topic("vehicle_attitude_setpoint", 40)
def _attitude_setpoint(m: np.ndarray, s: Samples) -> None:
    m["roll_body"], m["pitch_body"], m["yaw_body"] = to_eulers(s.control["sp_q"])
    m["yaw_sp_move_rate"] = np.nan_to_num(s.control["sp_yaw_rate"])
    m["q_d"] = s.control["sp_q"]
    m["thrust_body"][..., 2] = -s.control["sp_thrust"]


@_topic("vehicle_rates_setpoint", 20)
def _rates_setpoint(m: np.ndarray, s: Samples) -> None:
    m["roll"], m["pitch"], m["yaw"] = np.moveaxis(s.control["sp_rates"], -1, 0)
    m["thrust_body"][..., 2] = -s.control["sp_thrust"]


@_topic("rate_ctrl_status", 200)
def _rate_control_status(m: np.ndarray, s: Samples) -> None:
    integral = np.moveaxis(s.control["rate_integral"], -1, 0)
    m["rollspeed_integ"], m["pitchspeed_integ"], m["yawspeed_integ"] = integral


@_topic("vehicle_thrust_setpoint", 20)
def _thrust_setpoint(m: np.ndarray, s: Samples) -> None:
    m["xyz"][..., 2] = -s.control["sp_thrust"]


@_topic("vehicle_torque_setpoint", 20)
def _torque_setpoint(m: np.ndarray, s: Samples) -> None:
    m["xyz"] = s.control["sp_torque"]


@_topic("actuator_motors", 100, control=_NAN)
def _motors(m: np.ndarray, s: Samples) -> None:
    there = (np.arange(MAX_ROTORS) < s.rotors[:, None]) & (s.setpoint["armed"] != 0)[..., None]
    m["control"][..., :MAX_ROTORS] = np.where(there, s.control["actuators"], _NAN)


@_topic("actuator_outputs", 100)
def _outputs(m: np.ndarray, s: Samples) -> None:
    armed = (s.setpoint["armed"] != 0)[..., None]
    actuators = s.control["actuators"]  # of a disarmed vehicle above 0 only in a motor test
    pulses = np.where(armed | (actuators > 0.0), _MIN_PULSE + _PULSE_RANGE * actuators, _DISARMED_PULSE)
    m["noutputs"] = s.rotors
    m["output"][..., :MAX_ROTORS] = np.where(np.arange(MAX_ROTORS) < s.rotors[:, None], pulses, 0.0)


@_topic("takeoff_status", 1000)
def _takeoff_status(m: np.ndarray, s: Samples) -> None:
    m["takeoff_state"] = s.control["takeoff"]["state"] + 1  # PX4 counts from 1; 0 means "not initialised"
    m["tilt_limit"] = s.control["tilt_limit"]
