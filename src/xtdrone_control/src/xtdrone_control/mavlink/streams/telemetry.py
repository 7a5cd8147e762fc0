"""Field values of one vehicle's telemetry messages in wire order, and payloads of those with high rates.

``xtdrone_native.mavlink_wire`` builds the payloads directly from the autopilot's records. Local NED and body FRD,
quaternions (w, x, y, z), as in MAVLink. Times are simulated; SYSTEM_TIME counts from a fixed date, so that the same
flight yields the same bytes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from xtdrone_native import mavlink_wire

from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_control.geodesy.projection import EARTH_RADIUS, GRAVITY

if TYPE_CHECKING:
    from xtdrone_control.autopilot.autopilot import Autopilot

Values = tuple[Any, ...]
Content = Values | bytes
"""Field values of a message in wire order, or its payload."""

EPOCH_US = 1_577_836_800_000_000  # 2020-01-01 00:00 UTC, simulated time 0
PX4_AUTOPILOT = 12  # MAV_AUTOPILOT
_MAVLINK_VERSION = 3
_UNKNOWN_U16 = 0xFFFF
_INT16 = 32767
_UINT32 = (1 << 32) - 1

# MAV_SYS_STATUS_SENSOR. PX4 v1.14 does not report controllers as sensors, and reports absent sensors as healthy.
_GYRO, _ACCEL, _MAG, _BARO, _PITOT, _GPS = 1 << 0, 1 << 1, 1 << 2, 1 << 3, 1 << 4, 1 << 5
_MOTORS, _RC, _AHRS, _BATTERY, _PREARM, _AVOIDANCE = 1 << 15, 1 << 16, 1 << 21, 1 << 25, 1 << 28, 1 << 29
_PRESENT = _GYRO | _MAG | _BARO | _GPS | _MOTORS | _AHRS | _BATTERY
_ALWAYS_HEALTHY = _ACCEL | _PITOT | _AVOIDANCE
_HEALTHY_EXTENDED = 1
_FIX_3D = 3  # GPS_FIX_TYPE

_ESTIMATOR_FIELDS = (
    "q",
    "position",
    "velocity",
    "rates",
    "P",
    "terrain",
    "initialised",
    "altitude_valid",
    "terrain_valid",
)
_SENSOR_FIELDS = ("accel", "gyro", "mag", "baro_pressure", "baro_alt", "baro_temperature")
_CONTROL_FIELDS = (
    "sp_q",
    "sp_rates",
    "sp_thrust",
    "sp_position",
    "sp_velocity",
    "sp_acceleration",
    "sp_yaw",
    "sp_yaw_rate",
    "actuators",
)
_GRAVITY_UNITS = 1000.0 / GRAVITY


def _clamped(value: float, limit: int) -> int:
    """Return ``value`` rounded and clamped to -limit..limit; 0 for NaN."""
    if -limit < value < limit:
        return round(value)
    return 0 if value != value else int(math.copysign(limit, value))


def _unsigned(value: float, limit: int) -> int:
    return max(_clamped(value, limit), 0)


def _dilution(value: float) -> int:
    """Return a dilution of precision in hundredths, ``_UNKNOWN_U16`` if it is 0 or less."""
    return _unsigned(100.0 * value, _UNKNOWN_U16 - 1) if value > 0.0 else _UNKNOWN_U16


def _records(autopilot: Autopilot, index: int) -> mavlink_wire.Telemetry:
    """Return the telemetry that is built from the records of vehicle ``index``."""
    own = slice(index, index + 1)
    estimator = autopilot.estimator[own]
    fields = {name: estimator[name] for name in _ESTIMATOR_FIELDS}
    fields |= {f"origin_{name}": estimator["origin"][name] for name in ("set", "lat", "lon", "alt")}
    fields["reset_counter"] = estimator["resets"]["any"]
    fields |= {name: autopilot.sensors[own][name] for name in _SENSOR_FIELDS}
    fields |= {name: autopilot.control[own][name] for name in _CONTROL_FIELDS}
    return mavlink_wire.Telemetry(fields, fields["P"].shape[1], EARTH_RADIUS)


class Telemetry:
    """Telemetry of one vehicle.

    A method with the name of a message in lower case returns the values or the payload of that message.

    Attributes:
        time_us: simulated time of the values, microseconds.
        time_ms: the same in milliseconds, the unit of most messages.
        records: payloads of the messages with high rates.
        sensors: the vehicle's ``SENSORS`` record.
    """

    def __init__(self, commander: Commander, autopilot: Autopilot, index: int) -> None:
        """Read the records of vehicle ``index`` of ``autopilot``."""
        self._commander = commander
        self.sensors = autopilot.sensors[index]
        self._estimator = autopilot.estimator[index]
        self._control = autopilot.control[index]
        self.records = _records(autopilot, index)
        self._position = autopilot.estimator["position"][index]
        self._velocity = autopilot.estimator["velocity"][index]
        self._variances = np.diagonal(autopilot.estimator["P"][index])
        self.time_us = -1
        self.time_ms = 0

    @property
    def protocol(self) -> int:
        """MAV_PROTO_VER: 0 start with MAVLink 1, 1 always MAVLink 1, 2 start with MAVLink 2."""
        return int(self._commander.parameters.get("MAV_PROTO_VER"))

    def refresh(self, now_us: int) -> None:
        """Set the time, and record whether the estimator has an attitude and a position yet."""
        if now_us != self.time_us:
            self.time_us = now_us
            self.time_ms = now_us // 1000
            self.records.refresh(now_us)

    @property
    def located(self) -> bool:
        """Whether a position fix has been received; an estimate that has lost GPS is still valid."""
        return self.records.located

    @property
    def position(self) -> list[float]:
        """Estimated position, local NED, m."""
        return self._position.tolist()  # type: ignore[no-any-return]

    @property
    def velocity(self) -> list[float]:
        """Estimated velocity, local NED, m/s."""
        return self._velocity.tolist()  # type: ignore[no-any-return]

    def _home_z(self) -> float | None:
        """Return the down coordinate of home in the local frame, m, if home is set."""
        home = self._commander.home
        return None if home is None else home.position[2]

    def _height_over_home(self) -> float:
        home = self._commander.home
        return -self.position[2] if home is None else home.position[2] - self.position[2]

    # state

    def heartbeat(self) -> Values:
        """Return HEARTBEAT: mode, arming state and health."""
        c = self._commander
        kind = int(c.parameters.get("MAV_TYPE")) & 0xFF
        return c.custom_mode, kind, PX4_AUTOPILOT, c.base_mode, c.system_status, _MAVLINK_VERSION

    def extended_sys_state(self) -> Values:
        """Return EXTENDED_SYS_STATE: on the ground, in the air, taking off or landing."""
        return 0, self._commander.landed_state

    def sys_status(self) -> Values:
        """Return SYS_STATUS: sensors and battery; radio and joystick are one sensor, always enabled."""
        battery = self._commander.battery
        return (
            _PRESENT,
            _PRESENT | _RC,
            self._health(),
            0,
            _unsigned(battery.voltage * 1e3, _UNKNOWN_U16 - 1),
            _clamped(battery.current * 100.0, _INT16),
            0,
            0,
            0,
            0,
            0,
            0,
            _unsigned(math.ceil(battery.remaining * 100.0), 100),
            0,
            0,
            _HEALTHY_EXTENDED,
        )

    def _health(self) -> int:
        """Return the MAV_SYS_STATUS_SENSOR bits of the healthy sensors."""
        c, e, flags = self._commander, self._estimator, self._commander.health.flags
        conditions = (
            (_GYRO, not self.sensors["imu_missing"]),
            (_MAG, e["mag_good"]),
            (_BARO, e["baro_good"]),
            (_GPS, self.sensors["gps_fix"] >= _FIX_3D),
            (_MOTORS, not flags.motor_failure),
            (_RC, not flags.manual_lost),
            (_AHRS, not flags.attitude_invalid),
            (_BATTERY, not (flags.battery_unhealthy or flags.battery)),
            (_PREARM, c.armed or c.ready_to_arm),
        )
        return _ALWAYS_HEALTHY | sum(bit for bit, well in conditions if well)

    def battery_status(self) -> Values:
        """Return BATTERY_STATUS: lithium polymer, for all functions; a current of -1 A is unknown."""
        battery = self._commander.battery
        voltages = (_unsigned(battery.voltage * 1e3, _UNKNOWN_U16 - 1), *[_UNKNOWN_U16] * 9)
        current = _clamped(battery.current * 100.0, _INT16)
        remaining = _unsigned(math.ceil(battery.remaining * 100.0), 100)
        left = 0 if math.isnan(battery.time_remaining) else _clamped(battery.time_remaining, 1 << 30)
        used = _clamped(battery.discharged, 1 << 30)
        return (used, -1, _INT16, *voltages, current, 0, 1, 1, remaining, left, battery.warning + 1, 0, 0, 0, 0, 0, 0)

    def system_time(self) -> Values:
        """Return SYSTEM_TIME: simulated time since a fixed date."""
        return EPOCH_US + self.time_us, self.time_ms & _UINT32

    # attitude and position

    def attitude(self) -> bytes | None:
        """Return ATTITUDE: Euler angles (rad) and rates (rad/s), once the estimator is aligned."""
        return self.records.attitude()

    def attitude_quaternion(self) -> bytes | None:
        """Return ATTITUDE_QUATERNION: quaternion and rates (rad/s), once the estimator is aligned."""
        return self.records.attitude_quaternion()

    def local_position_ned(self) -> bytes | None:
        """Return LOCAL_POSITION_NED: position (m) and velocity (m/s), after the first fix."""
        return self.records.local_position_ned()

    def global_position_int(self) -> bytes | None:
        """Return GLOBAL_POSITION_INT while the global position is valid."""
        return self.records.global_position_int(self._home_z()) if self._commander.view.global_valid else None

    def altitude(self) -> bytes:
        """Return ALTITUDE: heights above sea, home, the local origin and, if known, the terrain, m."""
        return self.records.altitude(self._home_z())

    def vfr_hud(self) -> bytes:
        """Return VFR_HUD: the values of a head-up display."""
        return self.records.vfr_hud(self._commander.armed)

    def odometry(self) -> bytes | None:
        """Return ODOMETRY: pose and velocity in local NED with variances, as from PX4 v1.14's EKF2; after a fix."""
        return self.records.odometry()

    def estimator_status(self) -> Values:
        """Return ESTIMATOR_STATUS: innovation test ratios and accuracies (m)."""
        e = self._estimator
        ratio = e["test_ratio"]
        velocity, position, heading = ratio["vel"], ratio["pos"], ratio["mag"]
        if not e["gps_used"]:
            velocity = max(ratio["vision_vel"] * e["vision_velocity_used"], ratio["flow"] * e["flow_used"])
            position = ratio["vision_pos"]
        if e["vision_yaw_used"]:
            heading = ratio["vision_yaw"]
        ratios = (velocity, position, ratio["hgt"], heading, ratio["terrain"])
        return (
            self.time_us,
            *(math.sqrt(value) for value in ratios),
            0.0,
            float(e["eph"]),
            float(e["epv"]),
            int(e["flags"]),
        )

    def home_position(self) -> Values | None:
        """Return HOME_POSITION once it is set."""
        home = self._commander.home
        if home is None:
            return None
        half = 0.5 * home.yaw
        return (
            round(home.latitude * 1e7),
            round(home.longitude * 1e7),
            _clamped(home.altitude * 1e3, 1 << 30),
            *home.position,
            math.cos(half),
            0.0,
            0.0,
            math.sin(half),
            0.0,
            0.0,
            0.0,
            home.time_us,
        )

    def gps_global_origin(self) -> Values | None:
        """Return GPS_GLOBAL_ORIGIN once the origin of the local frame is set."""
        origin = self._estimator["origin"]
        if not origin["set"]:
            return None
        alt = _clamped(float(origin["alt"]) * 1e3, 1 << 30)
        return round(float(origin["lat"]) * 1e7), round(float(origin["lon"]) * 1e7), alt, self.time_us

    # sensors

    def gps_raw_int(self) -> Values:
        """Return GPS_RAW_INT: the last fix of the GPS receiver."""
        s = self.sensors
        vn, ve, _ = s["gps_vel"].tolist()
        alt = _clamped(float(s["gps_alt"]) * 1e3, 1 << 30)
        course = math.degrees(math.atan2(ve, vn)) % 360.0
        return (
            self.time_us,
            round(float(s["gps_lat"]) * 1e7),
            round(float(s["gps_lon"]) * 1e7),
            alt,
            *[_dilution(float(s[field])) for field in ("gps_hdop", "gps_vdop")],
            _unsigned(math.hypot(vn, ve) * 100.0, _UNKNOWN_U16 - 1),
            int(course * 100.0),
            int(s["gps_fix"]) & 0xFF,
            int(s["gps_satellites"]) & 0xFF,
            alt,
            _unsigned(float(s["gps_eph"]) * 1e3, 1 << 30),
            _unsigned(float(s["gps_epv"]) * 1e3, 1 << 30),
            _unsigned(float(s["gps_speed_accuracy"]) * 1e3, 1 << 30),
            0,
            0,
        )

    def highres_imu(self) -> bytes:
        """Return HIGHRES_IMU: accelerometer, gyroscope, magnetometer, barometer, in SI units, gauss and hPa."""
        return self.records.highres_imu(mavlink_wire.Samples())

    def scaled_imu(self) -> Values:
        """Return SCALED_IMU: accelerometer (milli-g), gyroscope (mrad/s), magnetometer (milligauss)."""
        s = self.sensors
        accel = [_clamped(v * _GRAVITY_UNITS, _INT16) for v in s["accel"].tolist()]
        gyro = [_clamped(v * 1e3, _INT16) for v in s["gyro"].tolist()]
        mag = [_clamped(v * 1e3, _INT16) for v in s["mag"].tolist()]
        temperature = _clamped(float(s["baro_temperature"]) * 100.0, _INT16)
        return (self.time_ms, *accel, *gyro, *mag, temperature)

    def scaled_pressure(self) -> Values:
        """Return SCALED_PRESSURE: the barometer, hPa and 0.01 degrees Celsius."""
        s = self.sensors
        temperature = _clamped(float(s["baro_temperature"]) * 100.0, _INT16)
        return self.time_ms, float(s["baro_pressure"]) * 0.01, 0.0, temperature, 0

    # setpoints and outputs

    def attitude_target(self) -> bytes:
        """Return ATTITUDE_TARGET: setpoints of the attitude and rate controllers, and thrust."""
        return self.records.attitude_target()

    def position_target_local_ned(self) -> bytes:
        """Return POSITION_TARGET_LOCAL_NED: trajectory setpoint; uncontrolled components are NaN and masked."""
        return self.records.position_target_local_ned()

    def servo_output_raw(self) -> bytes:
        """Return SERVO_OUTPUT_RAW: motor pulse widths, 1000..2000 us; 900 when disarmed and not under test."""
        return self.records.servo_output_raw(self._commander.armed)
