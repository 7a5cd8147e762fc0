"""Telemetry of the flight: state, attitude, position, sensors, setpoints; field values in wire order, or payloads."""

from __future__ import annotations

import math

from xtdrone_native import mavlink_wire

from xtdrone_autopilot.mavlink.streams.vehicle_state import EPOCH_US, Values, VehicleState
from xtdrone_common.geodesy.projection import GRAVITY

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

_GRAVITY_UNITS = 1000.0 / GRAVITY


def _clamp(value: float, limit: int) -> int:
    """Return ``value`` rounded and clamped to -limit..limit; 0 for NaN."""
    if -limit < value < limit:
        return round(value)
    return 0 if value != value else int(math.copysign(limit, value))


def _unsigned(value: float, limit: int) -> int:
    return max(_clamp(value, limit), 0)


def _dilution(value: float) -> int:
    """Return a dilution of precision in hundredths, ``_UNKNOWN_U16`` if it is 0 or less."""
    return _unsigned(100.0 * value, _UNKNOWN_U16 - 1) if value > 0.0 else _UNKNOWN_U16


class FlightTelemetry:
    """Messages on the flight of one vehicle; the name of a method is that of its message in lower case."""

    def __init__(self, vehicle: VehicleState) -> None:
        """Build the messages from ``vehicle``."""
        self._vehicle = vehicle

    def heartbeat(self) -> Values:
        """Return HEARTBEAT: mode, arming state and health."""
        c = self._vehicle.commander
        kind = int(c.parameters.get("MAV_TYPE")) & 0xFF
        return c.custom_mode, kind, PX4_AUTOPILOT, c.base_mode, c.system_status, _MAVLINK_VERSION

    def extended_sys_state(self) -> Values:
        """Return EXTENDED_SYS_STATE: on the ground, in the air, taking off or landing."""
        return 0, self._vehicle.commander.landed_state

    def sys_status(self) -> Values:
        """Return SYS_STATUS: sensors and battery; radio and joystick are one sensor, always enabled."""
        battery = self._vehicle.commander.battery
        voltage, current = _unsigned(battery.voltage * 1e3, _UNKNOWN_U16 - 1), _clamp(battery.current * 100.0, _INT16)
        remaining = _unsigned(math.ceil(battery.remaining * 100.0), 100)
        sensors = _PRESENT, _PRESENT | _RC, self._health()
        return *sensors, 0, voltage, current, *(0,) * 6, remaining, 0, 0, _HEALTHY_EXTENDED

    def _health(self) -> int:
        """Return the MAV_SYS_STATUS_SENSOR bits of the healthy sensors."""
        c, e, flags = self._vehicle.commander, self._vehicle.estimator, self._vehicle.commander.health.flags
        conditions = (
            (_GYRO, not self._vehicle.sensors["imu_missing"]),
            (_MAG, e["mag_good"]),
            (_BARO, e["baro_good"]),
            (_GPS, self._vehicle.sensors["gps_fix"] >= _FIX_3D),
            (_MOTORS, not flags.motor_failure),
            (_RC, not flags.manual_lost),
            (_AHRS, not flags.attitude_invalid),
            (_BATTERY, not (flags.battery_unhealthy or flags.battery)),
            (_PREARM, c.armed or c.ready_to_arm),
        )
        return _ALWAYS_HEALTHY | sum(bit for bit, well in conditions if well)

    def battery_status(self) -> Values:
        """Return BATTERY_STATUS: lithium polymer, for all functions; a current of -1 A is unknown."""
        battery = self._vehicle.commander.battery
        voltages = (_unsigned(battery.voltage * 1e3, _UNKNOWN_U16 - 1), *[_UNKNOWN_U16] * 9)
        current = _clamp(battery.current * 100.0, _INT16)
        remaining = _unsigned(math.ceil(battery.remaining * 100.0), 100)
        left = 0 if math.isnan(battery.time_remaining) else _clamp(battery.time_remaining, 1 << 30)
        used = _clamp(battery.discharged, 1 << 30)
        return (used, -1, _INT16, *voltages, current, 0, 1, 1, remaining, left, battery.warning + 1, 0, 0, 0, 0, 0, 0)

    def system_time(self) -> Values:
        """Return SYSTEM_TIME: simulated time since a fixed date."""
        return EPOCH_US + self._vehicle.time_us, self._vehicle.time_ms & _UINT32

    def attitude(self) -> bytes | None:
        """Return ATTITUDE: Euler angles (rad) and rates (rad/s), once the estimator is aligned."""
        return self._vehicle.records.attitude()

    def attitude_quaternion(self) -> bytes | None:
        """Return ATTITUDE_QUATERNION: quaternion and rates (rad/s), once the estimator is aligned."""
        return self._vehicle.records.attitude_quaternion()

    def local_position_ned(self) -> bytes | None:
        """Return LOCAL_POSITION_NED: position (m) and velocity (m/s), after the first fix."""
        return self._vehicle.records.local_position_ned()

    def global_position_int(self) -> bytes | None:
        """Return GLOBAL_POSITION_INT while the global position is valid."""
        valid = self._vehicle.commander.view.global_valid
        return self._vehicle.records.global_position_int(self._vehicle.home_z()) if valid else None

    def altitude(self) -> bytes:
        """Return ALTITUDE: heights above sea, home, the local origin and, if known, the terrain, m."""
        return self._vehicle.records.altitude(self._vehicle.home_z())

    def vfr_hud(self) -> bytes:
        """Return VFR_HUD: the values of a head-up display."""
        return self._vehicle.records.vfr_hud(self._vehicle.commander.armed)

    def odometry(self) -> bytes | None:
        """Return ODOMETRY: pose and velocity in local NED with variances, as from PX4 v1.14's EKF2; after a fix."""
        return self._vehicle.records.odometry()

    def estimator_status(self) -> Values:
        """Return ESTIMATOR_STATUS: innovation test ratios and accuracies (m)."""
        e = self._vehicle.estimator
        ratio = e["test_ratio"]
        velocity, position, heading = ratio["vel"], ratio["pos"], ratio["mag"]
        if not e["gps_used"]:
            velocity = max(ratio["vision_vel"] * e["vision_velocity_used"], ratio["flow"] * e["flow_used"])
            position = ratio["vision_pos"]
        if e["vision_yaw_used"]:
            heading = ratio["vision_yaw"]
        ratios = [math.sqrt(value) for value in (velocity, position, ratio["hgt"], heading, ratio["terrain"])]
        return self._vehicle.time_us, *ratios, 0.0, float(e["eph"]), float(e["epv"]), int(e["flags"])

    def home_position(self) -> Values | None:
        """Return HOME_POSITION once it is set."""
        home = self._vehicle.commander.home
        if home is None:
            return None
        place = round(home.latitude * 1e7), round(home.longitude * 1e7), _clamp(home.altitude * 1e3, 1 << 30)
        q = math.cos(0.5 * home.yaw), 0.0, 0.0, math.sin(0.5 * home.yaw)
        return *place, *home.position, *q, 0.0, 0.0, 0.0, home.time_us

    def gps_global_origin(self) -> Values | None:
        """Return GPS_GLOBAL_ORIGIN once the origin of the local frame is set."""
        origin = self._vehicle.estimator["origin"]
        if not origin["set"]:
            return None
        alt = _clamp(float(origin["alt"]) * 1e3, 1 << 30)
        return round(float(origin["lat"]) * 1e7), round(float(origin["lon"]) * 1e7), alt, self._vehicle.time_us

    def gps_raw_int(self) -> Values:
        """Return GPS_RAW_INT: the last fix of the GPS receiver."""
        s = self._vehicle.sensors
        vn, ve, _ = s["gps_vel"].tolist()
        alt = _clamp(float(s["gps_alt"]) * 1e3, 1 << 30)
        place = round(float(s["gps_lat"]) * 1e7), round(float(s["gps_lon"]) * 1e7), alt
        dilutions = [_dilution(float(s[field])) for field in ("gps_hdop", "gps_vdop")]
        speed = _unsigned(math.hypot(vn, ve) * 100.0, _UNKNOWN_U16 - 1)
        course = int(math.degrees(math.atan2(ve, vn)) % 360.0 * 100.0)
        fix = int(s["gps_fix"]) & 0xFF, int(s["gps_satellites"]) & 0xFF
        accuracies = [_unsigned(float(s[f"gps_{field}"]) * 1e3, 1 << 30) for field in ("eph", "epv", "speed_accuracy")]
        return self._vehicle.time_us, *place, *dilutions, speed, course, *fix, alt, *accuracies, 0, 0

    def highres_imu(self) -> bytes:
        """Return HIGHRES_IMU: accelerometer, gyroscope, magnetometer, barometer, in SI units, gauss and hPa."""
        return self._vehicle.records.highres_imu(mavlink_wire.Samples())

    def scaled_imu(self) -> Values:
        """Return SCALED_IMU: accelerometer (milli-g), gyroscope (mrad/s), magnetometer (milligauss)."""
        s = self._vehicle.sensors
        accel = [_clamp(v * _GRAVITY_UNITS, _INT16) for v in s["accel"].tolist()]
        gyro = [_clamp(v * 1e3, _INT16) for v in s["gyro"].tolist()]
        mag = [_clamp(v * 1e3, _INT16) for v in s["mag"].tolist()]
        temperature = _clamp(float(s["baro_temperature"]) * 100.0, _INT16)
        return (self._vehicle.time_ms, *accel, *gyro, *mag, temperature)

    def scaled_pressure(self) -> Values:
        """Return SCALED_PRESSURE: the barometer, hPa and 0.01 degrees Celsius."""
        s = self._vehicle.sensors
        temperature = _clamp(float(s["baro_temperature"]) * 100.0, _INT16)
        return self._vehicle.time_ms, float(s["baro_pressure"]) * 0.01, 0.0, temperature, 0

    def attitude_target(self) -> bytes:
        """Return ATTITUDE_TARGET: setpoints of the attitude and rate controllers, and thrust."""
        return self._vehicle.records.attitude_target()

    def position_target_local_ned(self) -> bytes:
        """Return POSITION_TARGET_LOCAL_NED: trajectory setpoint; uncontrolled components are NaN and masked."""
        return self._vehicle.records.position_target_local_ned()

    def servo_output_raw(self) -> bytes:
        """Return SERVO_OUTPUT_RAW: motor pulse widths, 1000..2000 us; 900 when disarmed and not under test."""
        return self._vehicle.records.servo_output_raw(self._vehicle.commander.armed)
