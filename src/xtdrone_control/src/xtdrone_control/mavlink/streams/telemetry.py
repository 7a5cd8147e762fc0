"""Field values of one vehicle's telemetry messages, in wire order.

Local NED and body FRD, quaternions (w, x, y, z), as in MAVLink. Times are simulated; SYSTEM_TIME counts from a fixed
date, so that the same flight yields the same bytes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from xtdrone_control import rotation
from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_control.geodesy import geo
from xtdrone_control.geodesy.geo import GRAVITY

if TYPE_CHECKING:
    from xtdrone_control.autopilot.autopilot import Autopilot

Values = tuple[Any, ...]

EPOCH_US = 1_577_836_800_000_000  # 2020-01-01 00:00 UTC, simulated time 0
PX4_AUTOPILOT = 12  # MAV_AUTOPILOT
_MAVLINK_VERSION = 3
_UNKNOWN_U16 = 0xFFFF
_NAN = math.nan
_INT16 = 32767
_UINT32 = (1 << 32) - 1

# HIGHRES_IMU_UPDATED_FLAGS
_IMU_FIELDS, _MAG_FIELDS, _BARO_FIELDS = 0x3F, 0x1C0, 0x1E00

# MAV_SYS_STATUS_SENSOR. PX4 v1.14 does not report controllers as sensors, and reports absent sensors as healthy.
_GYRO, _ACCEL, _MAG, _BARO, _PITOT, _GPS = 1 << 0, 1 << 1, 1 << 2, 1 << 3, 1 << 4, 1 << 5
_MOTORS, _RC, _AHRS, _BATTERY, _PREARM, _AVOIDANCE = 1 << 15, 1 << 16, 1 << 21, 1 << 25, 1 << 28, 1 << 29
_PRESENT = _GYRO | _MAG | _BARO | _GPS | _MOTORS | _AHRS | _BATTERY
_ALWAYS_HEALTHY = _ACCEL | _PITOT | _AVOIDANCE
_HEALTHY_EXTENDED = 1
_FIX_3D = 3  # GPS_FIX_TYPE

_DISARMED_PWM, _LEAST_PWM = 900, 1000
_FRAME_LOCAL_NED, _ESTIMATOR_AUTOPILOT = 1, 8
_GRAVITY_UNITS = 1000.0 / GRAVITY
# indices of the diagonal of a 6 x 6 matrix in its upper triangle, row by row
_DIAGONAL = (0, 6, 11, 15, 18, 20)


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


def _diagonal(values: list[float]) -> list[float]:
    matrix = [0.0] * 21
    for i, value in zip(_DIAGONAL, values, strict=True):
        matrix[i] = value
    return matrix


class Telemetry:
    """Telemetry of one vehicle. A method with the name of a message in lower case returns the values of that message.

    Attributes:
        time_us: simulated time of the values, microseconds.
        time_ms: the same in milliseconds, the unit of most messages.
        aligned: whether the estimator has an attitude.
        located: whether a position fix has been received.
        sensors: the vehicle's ``SENSORS`` record.
    """

    def __init__(self, commander: Commander, autopilot: Autopilot, index: int) -> None:
        """Read the records of vehicle ``index`` of ``autopilot``."""
        self._commander = commander
        self.sensors = autopilot.sensors[index]
        self._estimator = autopilot.estimator[index]
        self._control = autopilot.control[index]
        # views of the fields that most messages need: access by name costs three times as much
        self._position = autopilot.estimator["position"][index]
        self._velocity = autopilot.estimator["velocity"][index]
        self._q = autopilot.estimator["q"][index]
        self._rates = autopilot.estimator["rates"][index]
        self._variances = np.diagonal(autopilot.estimator["P"][index])
        self.time_us = -1
        self.time_ms = 0
        self._euler: tuple[float, float, float] | None = None
        self.aligned = self.located = False

    @property
    def protocol(self) -> int:
        """MAV_PROTO_VER: 0 start with MAVLink 1, 1 always MAVLink 1, 2 start with MAVLink 2."""
        return int(self._commander.parameters.get("MAV_PROTO_VER"))

    def refresh(self, now_us: int) -> None:
        """Read the estimate, once for each ``now_us``."""
        if now_us == self.time_us:
            return
        self.time_us = now_us
        self.time_ms = now_us // 1000
        self.position = self._position.tolist()
        self.velocity = self._velocity.tolist()
        self.q = self._q.tolist()
        self.rates = self._rates.tolist()
        self._euler = None
        # both stay true: an estimate that has lost GPS is still valid
        self.aligned = self.aligned or bool(self._estimator["initialised"])
        self.located = self.located or bool(self._estimator["altitude_valid"])

    def _angles(self) -> tuple[float, float, float]:
        """Return roll, pitch and yaw in radians."""
        if self._euler is None:
            self._euler = rotation.to_euler(self.q)
        return self._euler

    def _heading(self) -> float:
        """Return the heading in degrees, 0..360."""
        return math.degrees(self._angles()[2]) % 360.0

    def _altitude(self) -> float:
        return float(self._estimator["origin_alt"]) - self.position[2]

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

    def attitude(self) -> Values | None:
        """Return ATTITUDE: Euler angles (rad) and rates (rad/s), once the estimator is aligned."""
        return None if not self.aligned else (self.time_ms, *self._angles(), *self.rates)

    def attitude_quaternion(self) -> Values | None:
        """Return ATTITUDE_QUATERNION: quaternion and rates (rad/s), once the estimator is aligned."""
        return None if not self.aligned else (self.time_ms, *self.q, *self.rates, 0.0, 0.0, 0.0, 0.0)

    def local_position_ned(self) -> Values | None:
        """Return LOCAL_POSITION_NED: position (m) and velocity (m/s), after the first fix."""
        return None if not self.located else (self.time_ms, *self.position, *self.velocity)

    def global_position_int(self) -> Values | None:
        """Return GLOBAL_POSITION_INT while the global position is valid."""
        if not self._commander.view.global_valid:
            return None
        lat, lon = self._latitude_longitude()
        vx, vy, vz = self.velocity
        return (
            self.time_ms,
            round(lat * 1e7),
            round(lon * 1e7),
            _clamped(self._altitude() * 1e3, 1 << 30),
            _clamped(self._height_over_home() * 1e3, 1 << 30),
            _clamped(vx * 100.0, _INT16),
            _clamped(vy * 100.0, _INT16),
            _clamped(vz * 100.0, _INT16),
            int(self._heading() * 100.0),
        )

    def _latitude_longitude(self) -> tuple[float, float]:
        e = self._estimator
        return geo.reproject(self.position[0], self.position[1], float(e["origin_lat"]), float(e["origin_lon"]))

    def altitude(self) -> Values:
        """Return ALTITUDE: heights above sea, home, the local origin and, if known, the terrain, m."""
        e = self._estimator
        amsl = self._altitude() if e["origin_set"] else _NAN
        ground = clearance = _NAN
        if e["terrain_valid"]:
            clearance = float(e["terrain"]) - self.position[2]
            ground = amsl - clearance
        return self.time_us, amsl, amsl, -self.position[2], self._height_over_home(), ground, clearance

    def vfr_hud(self) -> Values:
        """Return VFR_HUD: the values of a head-up display."""
        vx, vy, vz = self.velocity
        throttle = _unsigned(100.0 * float(self._control["sp_thrust"]), 100) if self._commander.armed else 0
        return 0.0, math.hypot(vx, vy), self._altitude(), -vz, int(self._heading()), throttle

    def odometry(self) -> Values | None:
        """Return ODOMETRY: pose and velocity in local NED with variances, as from PX4 v1.14's EKF2; after a fix."""
        if not self.located:
            return None
        p = self._variances.tolist()
        pose, velocity = _diagonal(p[6:9] + p[0:3]), _diagonal(p[3:6] + p[9:12])
        resets = int(self._estimator["reset_counter"]) & 0xFF
        return (
            self.time_us,
            *self.position,
            *self.q,
            *self.velocity,
            *self.rates,
            *pose,
            *velocity,
            _FRAME_LOCAL_NED,
            _FRAME_LOCAL_NED,
            resets,
            _ESTIMATOR_AUTOPILOT,
            0,
        )

    def estimator_status(self) -> Values:
        """Return ESTIMATOR_STATUS: innovation test ratios and accuracies (m)."""
        e = self._estimator
        velocity, position, heading = e["test_ratio_vel"], e["test_ratio_pos"], e["test_ratio_mag"]
        if not e["gps_used"]:
            velocity = max(
                e["test_ratio_vision_vel"] * e["vision_velocity_used"], e["test_ratio_flow"] * e["flow_used"]
            )
            position = e["test_ratio_vision_pos"]
        if e["vision_yaw_used"]:
            heading = e["test_ratio_vision_yaw"]
        ratios = (velocity, position, e["test_ratio_hgt"], heading, e["test_ratio_terrain"])
        return (
            self.time_us,
            *(math.sqrt(ratio) for ratio in ratios),
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
        e = self._estimator
        if not e["origin_set"]:
            return None
        alt = _clamped(float(e["origin_alt"]) * 1e3, 1 << 30)
        return round(float(e["origin_lat"]) * 1e7), round(float(e["origin_lon"]) * 1e7), alt, self.time_us

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

    def highres_imu(self, *, mag: bool = True, baro: bool = True) -> Values:
        """Return HIGHRES_IMU: accelerometer, gyroscope, magnetometer, barometer, in SI units, gauss and hPa.

        Args:
            mag: whether the magnetometer has a new sample since the last message.
            baro: whether the barometer has; this covers the differential pressure, 0 without an airspeed sensor.
        """
        s = self.sensors
        updated = _IMU_FIELDS | (_MAG_FIELDS if mag else 0) | (_BARO_FIELDS if baro else 0)
        return (
            self.time_us,
            *s["accel"].tolist(),
            *s["gyro"].tolist(),
            *s["mag"].tolist(),
            float(s["baro_pressure"]) * 0.01,
            0.0,
            float(s["baro_alt"]),
            float(s["baro_temperature"]),
            updated,
            0,
        )

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

    def attitude_target(self) -> Values:
        """Return ATTITUDE_TARGET: setpoints of the attitude and rate controllers, and thrust."""
        c = self._control
        return (self.time_ms, *c["sp_q"].tolist(), *c["sp_rates"].tolist(), float(c["sp_thrust"]), 0)

    def position_target_local_ned(self) -> Values:
        """Return POSITION_TARGET_LOCAL_NED: trajectory setpoint; uncontrolled components are NaN and masked."""
        c = self._control
        values = [*c["sp_position"].tolist(), *c["sp_velocity"].tolist(), *c["sp_acceleration"].tolist()]
        turn = [float(c["sp_yaw"]), float(c["sp_yaw_rate"])]
        mask = sum(1 << bit for bit, value in enumerate(values) if value != value)
        mask |= sum(1 << bit for bit, value in enumerate(turn, 10) if value != value)
        return (self.time_ms, *values, *turn, mask, _FRAME_LOCAL_NED)

    def servo_output_raw(self) -> Values:
        """Return SERVO_OUTPUT_RAW: motor pulse widths, 1000..2000 us; 900 when disarmed and not under test."""
        armed = self._commander.armed
        pulses = [
            _LEAST_PWM + _unsigned(1000.0 * value, 1000) if armed or value > 0.0 else _DISARMED_PWM
            for value in self._control["actuators"].tolist()
        ]
        return (self.time_us & _UINT32, *pulses, 0, 0, 0, 0, 0, 0, 0, 0, 0)
