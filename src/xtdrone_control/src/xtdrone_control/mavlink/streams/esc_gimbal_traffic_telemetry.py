"""Telemetry sent rarely or only on request: ESCs, air traffic, gimbal, time, and streams without a simulated sensor.

Field values are those of PX4 v1.14's streams (src/modules/mavlink/streams); Open Drone ID is ASTM F3411's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control import frames, modes
from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_control.autopilot.commander.manual_control import CHANNELS
from xtdrone_control.autopilot.flight_tasks.obstacle_map import FORWARD_FRAME
from xtdrone_control.autopilot.navigator import gimbal_manager
from xtdrone_control.autopilot.state import OBSTACLE_BINS, TASK_GOTO, TASK_LAND
from xtdrone_control.geodesy import projection
from xtdrone_control.mavlink.streams.telemetry import EPOCH_US, Content, Telemetry, Values

if TYPE_CHECKING:
    from xtdrone_control.autopilot.autopilot import Autopilot

_NANOSECONDS = 1000  # a microsecond
_FRAME_GLOBAL_INT = 5
_ESC_BATCH = 4  # ESCs in one message
_ESC_BUS = 2  # ESC_CONNECTION_TYPE_ONESHOT
_ESC_COLD, _ESC_WARMING = 20.0, 40.0  # deg C
_UTM_FLAGS = 1 | 4 | 8 | 32 | 64  # time, position, altitude, horizontal and vertical velocity
_UTM_NEXT_WAYPOINT = 128
_UTM_UNKNOWN, _UTM_GROUND, _UTM_AIRBORNE = 1, 2, 3
_ODID_GROUND, _ODID_AIRBORNE, _ODID_EMERGENCY = 1, 2, 3
_ODID_EPOCH_US = 1_546_300_800_000_000  # 2019-01-01 00:00 UTC
_ODID_UNKNOWN_HEIGHT = -1000.0  # m
_ODID_SECOND = 10  # MAV_ODID_TIME_ACC_1_0_SECOND
_HOUR_MS = 3_600_000
# upper bound and MAV_ODID_HOR_ACC, _VER_ACC, _SPEED_ACC
_HORIZONTAL_ACCURACY = ((1.0, 12), (3.0, 11), (10.0, 10), (30.0, 9))
_VERTICAL_ACCURACY = ((1.0, 6), (3.0, 5), (10.0, 4), (25.0, 3), (45.0, 2), (150.0, 1))
_SPEED_ACCURACY = ((0.3, 4), (1.0, 3), (3.0, 2), (10.0, 1))
_CRITICAL_STATUS = 5  # MAV_STATE_CRITICAL: a failsafe is active
_INT16 = 32767
_UINT16 = 65535
_UNKNOWN_TIME = -1
_FULL_SIGNAL = 100  # % of RC_CHANNELS.rssi
_NAN = math.nan
GIMBAL_DEVICE = 1  # id of a gimbal driven by the autopilot, not a MAVLink device
GIMBAL_CAPABILITIES = (
    mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_NEUTRAL
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_ROLL_LOCK
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_PITCH_AXIS
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_PITCH_LOCK
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_YAW_AXIS
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_YAW_FOLLOW
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_YAW_LOCK
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_CAN_POINT_LOCATION_GLOBAL
)
GIMBAL_RANGE = (
    0.0,
    0.0,
    -0.5 * math.pi,
    0.5 * math.pi,
    -math.pi,
    math.pi,
)  # rad, limits of roll, pitch, yaw
_LASER, _DOWNWARD = 0, 25  # MAV_DISTANCE_SENSOR, MAV_SENSOR_ORIENTATION
_OBSTACLE_DISTANCES = 72  # in OBSTACLE_DISTANCE
_FLOW_SPAN_US = 20_000
_SENSOR_TIMEOUT_US = 500_000

# Streams of PX4 v1.14 for sensors, devices and modes that are not simulated: intervals can be set, nothing is sent.
SILENT = (
    "ADSB_VEHICLE",
    "ATT_POS_MOCAP",
    "CAMERA_IMAGE_CAPTURED",
    "CAMERA_TRIGGER",
    "COLLISION",
    "DEBUG",
    "DEBUG_FLOAT_ARRAY",
    "DEBUG_VECT",
    "EFI_STATUS",
    "GIMBAL_DEVICE_SET_ATTITUDE",
    "GPS2_RAW",
    "GPS_STATUS",
    "MAG_CAL_REPORT",
    "NAMED_VALUE_FLOAT",
    "NAV_CONTROLLER_OUTPUT",
    "OPEN_DRONE_ID_BASIC_ID",
    "RAW_RPM",
    "SCALED_IMU2",
    "SCALED_IMU3",
    "SCALED_PRESSURE2",
    "SCALED_PRESSURE3",
    "TRAJECTORY_REPRESENTATION_WAYPOINTS",
    "WIND_COV",
)


def _class_of(value: float, classes: tuple[tuple[float, int], ...]) -> int:
    """Return the number of the first class with a bound above ``value``; 0 if no bound is."""
    return next((number for bound, number in classes if value < bound), 0)


class VehicleTelemetry(Telemetry):
    """All telemetry of one vehicle; see ``Telemetry``."""

    def __init__(self, commander: Commander, autopilot: Autopilot, index: int) -> None:
        """Read the records of vehicle ``index`` of ``autopilot``."""
        super().__init__(commander, autopilot, index)
        self._setpoint = autopilot.setpoint[index]
        self._rotor_count = int(autopilot.rotors[index])

    # time

    def timesync(self) -> Values:
        """Return TIMESYNC, with which PX4 measures the offset of the clocks; the reply is ignored."""
        return 0, self.time_us * _NANOSECONDS

    def time_estimate_to_target(self) -> Values | None:
        """Return TIME_ESTIMATE_TO_TARGET: time of a return, s, with PX4's margins; the other times are unknown."""
        seconds = self._return_time()
        if seconds is None:
            return None
        return round(seconds), _UNKNOWN_TIME, _UNKNOWN_TIME, _UNKNOWN_TIME, _UNKNOWN_TIME

    def _return_time(self) -> float | None:
        home = self._commander.home
        if home is None or not self.located:
            return None
        get = self._commander.parameters.get
        height = self._height_over_home()
        distance = math.hypot(self.position[0] - home.position[0], self.position[1] - home.position[1])
        if self._control["landing"]["landed"]:
            seconds = 0.0
        else:
            top = max(get("RTL_RETURN_ALT"), height)
            low = min(get("RTL_DESCEND_ALT"), top)
            seconds = (
                (top - height) / get("MPC_Z_V_AUTO_UP")
                + distance / get("MPC_XY_CRUISE")
                + (top - low) / get("MPC_Z_V_AUTO_DN")
                + low / get("MPC_LAND_SPEED")
            )
        return get("RTL_TIME_FACTOR") * seconds + get("RTL_TIME_MARGIN")

    # motors

    def _batches(self, values: list[float]) -> list[list[float]]:
        """Return one value for each motor in batches of four, padded with zeros."""
        count = self._rotor_count
        kept = [*values[:count], *[0.0] * (len(values) - count)]
        return [kept[start : start + _ESC_BATCH] for start in range(0, max(count, 1), _ESC_BATCH)]

    def esc_info(self) -> list[Values]:
        """Return ESC_INFO: healthy ESCs, with the temperatures that PX4's SITL derives from the motor commands."""
        online = (1 << self._rotor_count) - 1
        counter = self.time_us // 4000 & _UINT16
        commands = [max(0.0, command) for command in self._control["actuators"].tolist()]  # NaN becomes 0
        return [
            (
                self.time_us,
                *(0, 0, 0, 0),
                counter,
                *(0, 0, 0, 0),
                *[round(100.0 * (_ESC_COLD + _ESC_WARMING * command)) for command in batch],
                _ESC_BATCH * number,
                self._rotor_count,
                _ESC_BUS,
                online & 0xFF,
            )
            for number, batch in enumerate(self._batches(commands))
        ]

    def esc_status(self) -> list[Values]:
        """Return ESC_STATUS: speed (rev/min), voltage (V) and current (A) of each motor."""
        voltage = self._commander.battery.voltage
        speeds = self._batches(self.sensors["esc_rpm"].tolist())
        currents = self._batches(self.sensors["esc_current"].tolist())
        return [
            (
                self.time_us,
                *[round(speed) for speed in speeds[number]],
                *[voltage] * _ESC_BATCH,
                *currents[number],
                _ESC_BATCH * number,
            )
            for number in range(len(speeds))
        ]

    def actuator_control_target(self) -> Values:
        """Return ACTUATOR_CONTROL_TARGET: torque (normalised, FRD) and collective thrust demanded of the allocator."""
        c = self._control
        return self.time_us, *c["sp_torque"].tolist(), float(c["sp_thrust"]), 0.0, 0.0, 0.0, 0.0, 0

    def actuator_output_status(self) -> Values:
        """Return ACTUATOR_OUTPUT_STATUS: motor commands, 0..1."""
        motors = self._control["actuators"].tolist()
        return self.time_us, self._rotor_count, *motors, *[0.0] * (32 - len(motors))

    # sensors

    def vibration(self) -> Values:
        """Return VIBRATION: PX4's vibration metrics; the simulated accelerometers never clip."""
        return self.time_us, *self._estimator["vibration"]["metrics"].tolist(), 0, 0, 0

    def distance_sensor(self) -> Values | None:
        """Return DISTANCE_SENSOR: the downward range finder, cm, while its samples are recent."""
        s, quality = self.sensors, int(self.sensors["range_quality"])
        if not self._is_recent("time_range_us"):
            return None
        return (
            self.time_ms,
            *[_whole(100.0 * float(s[field]), 0, _UINT16) for field in ("range_least", "range_largest")],
            _whole(100.0 * float(s["range_distance"]), 0, _UINT16),
            _LASER,
            0,
            _DOWNWARD,
            0,
            0.0,
            0.0,
            *[0.0] * 4,
            0 if quality < 0 else max(quality, 1),  # 0 means unknown, 1 invalid
        )

    def optical_flow_rad(self) -> Values | None:
        """Return OPTICAL_FLOW_RAD while samples are recent: angles over ``_FLOW_SPAN_US`` at the last rates."""
        if not self._is_recent("time_flow_us"):
            return None
        s, span = self.sensors, _FLOW_SPAN_US * 1e-6
        gyro = [rate * span for rate in s["flow_gyro"].tolist()]
        distance = float(s["range_distance"]) if self._is_recent("time_range_us") else -1.0
        return (
            self.time_us,
            _FLOW_SPAN_US,
            *[rate * span for rate in s["flow_rate"].tolist()],
            *gyro,
            _NAN,
            0,
            distance,
            0,
            0,
            _whole(int(s["flow_quality"]), 0, 255),
        )

    def _is_recent(self, field: str) -> bool:
        """Return whether a sensor's last sample, its time in the estimator's ``field``, is less than 0.5 s old."""
        last = int(self._estimator[field])
        return last > 0 and self.time_us - last < _SENSOR_TIMEOUT_US

    # gimbal, if fitted

    def mount_orientation(self) -> Values | None:
        """Return MOUNT_ORIENTATION: gimbal attitude, degrees, yaw relative to the heading and to north."""
        attitude = self._commander.navigator.payload.gimbal_attitude
        if attitude is None:
            return None
        roll, pitch, yaw = (math.degrees(angle) for angle in attitude)
        return self.time_ms, roll, pitch, yaw, (yaw + math.degrees(self._commander.view.yaw)) % 360.0

    def gimbal_device_attitude_status(self) -> Values | None:
        """Return GIMBAL_DEVICE_ATTITUDE_STATUS: q (w, x, y, z), yaw relative to the heading, or to north if locked."""
        payload = self._commander.navigator.payload
        attitude = payload.gimbal_attitude
        if attitude is None:
            return None
        flags, heading = payload.gimbal_manager.flags, self._commander.view.yaw
        locked = bool(flags & gimbal_manager.YAW_LOCK)
        roll, pitch, yaw = attitude
        q = frames.quaternion_from_rpy(roll, pitch, yaw + heading if locked else yaw)
        flags |= gimbal_manager.YAW_IN_EARTH_FRAME if locked else gimbal_manager.YAW_IN_VEHICLE_FRAME
        return self.time_ms, *q, _NAN, _NAN, _NAN, 0, flags, 0, 0, heading, _NAN, GIMBAL_DEVICE

    def gimbal_manager_status(self) -> Values | None:
        """Return GIMBAL_MANAGER_STATUS: the systems with primary and secondary control."""
        payload = self._commander.navigator.payload
        if payload.gimbal_attitude is None:
            return None
        manager = payload.gimbal_manager
        return self.time_ms, manager.flags, GIMBAL_DEVICE, *manager.primary, *manager.secondary

    def gimbal_manager_information(self) -> Values | None:
        """Return GIMBAL_MANAGER_INFORMATION: capabilities, as of PX4's driver for a gimbal without MAVLink."""
        if self._commander.navigator.payload.gimbal_attitude is None:
            return None
        return self.time_ms, GIMBAL_CAPABILITIES, *GIMBAL_RANGE, GIMBAL_DEVICE

    # pilot input

    def rc_channels(self) -> Values | None:
        """Return RC_CHANNELS: pulse widths, us, while a radio is in use."""
        manual = self._commander.manual
        channels = manual.channels
        if not channels or not manual.by_radio:
            return None
        pulses = [*channels, *[_UINT16] * (CHANNELS - len(channels))]
        return self.time_ms, *pulses, len(channels), _FULL_SIGNAL

    def manual_control(self) -> Values | None:
        """Return MANUAL_CONTROL: stick positions, -1000..1000, throttle 0..1000."""
        sticks = self._commander.manual.sticks
        if sticks is None:
            return None
        x, y, yaw = (round(1000.0 * value) for value in (sticks.x, sticks.y, sticks.yaw))
        system = self._commander.vehicle.system_id
        return x, y, round(500.0 * (sticks.z + 1.0)), yaw, 0, system, *[0] * 10

    # navigation target

    def _goal(self) -> list[float] | None:
        """Return the target of the automatic mode, local position (m, NED); None in other modes."""
        if not self._commander.armed or int(self._setpoint["task"]) not in (TASK_GOTO, TASK_LAND):
            return None
        goal: list[float] = self._setpoint["goal_position"].tolist()
        return goal if all(map(math.isfinite, goal)) else None

    def _global_position(self, position: list[float]) -> tuple[int, int, float]:
        """Return latitude and longitude in 1e-7 degrees, and altitude in m AMSL, of a local position."""
        e = self._estimator
        lat, lon = projection.reproject(position[0], position[1], float(e["origin"]["lat"]), float(e["origin"]["lon"]))
        return round(lat * 1e7), round(lon * 1e7), float(e["origin"]["alt"]) - position[2]

    def position_target_global_int(self) -> Values | None:
        """Return POSITION_TARGET_GLOBAL_INT: target of the automatic mode and the current trajectory setpoint."""
        goal = self._goal()
        if goal is None:
            return None
        c = self._control
        return (
            self.time_ms,
            *self._global_position(goal),
            *c["sp_velocity"].tolist(),
            *c["sp_acceleration"].tolist(),
            float(c["sp_yaw"]),
            float(c["sp_yaw_rate"]),
            0,
            _FRAME_GLOBAL_INT,
        )

    def orbit_execution_status(self) -> Values | None:
        """Return ORBIT_EXECUTION_STATUS: the circle being flown; None outside ORBIT."""
        if self._commander.mode is not modes.ORBIT or not self._commander.armed:
            return None
        orbit = self._commander.navigator.orbit
        radius = math.copysign(orbit.radius, orbit.speed)
        goal = [*orbit.centre, float(self._setpoint["goal_position"][2])]
        latitude, longitude, altitude = self._global_position(goal)
        return self.time_us, radius, latitude, longitude, altitude, 0

    def obstacle_distance(self) -> Values | None:
        """Return OBSTACLE_DISTANCE: collision prevention's map, clockwise from the nose, while it is in use."""
        found = self._control["obstacles"]
        in_use = self._commander.armed and self._commander.mode is modes.POSCTL and found["active_us"] >= 0
        if not in_use or self._commander.parameters.get("CP_DIST") <= 0.0:
            return None
        distances = [int(value) for value in found["distances"]]
        distances += [_UINT16] * (_OBSTACLE_DISTANCES - len(distances))
        least, largest = int(found["least"]), int(found["largest"])
        time_us, width = int(found["time_us"]), 360.0 / OBSTACLE_BINS
        return time_us, *distances, least, largest, 0, 0, width, 0.0, FORWARD_FRAME

    # air traffic

    def utm_global_position(self) -> Values | None:
        """Return UTM_GLOBAL_POSITION while the global position is valid; altitudes in mm AMSL."""
        if not self._commander.view.global_valid:
            return None
        lat, lon, alt = self._global_position(self.position)
        goal = self._goal()
        flags = _UTM_FLAGS | (0 if goal is None else _UTM_NEXT_WAYPOINT)
        next_lat, next_lon, next_alt = (0, 0, 0.0) if goal is None else self._global_position(goal)
        variances = [max(value, 0.0) for value in self._variances.tolist()]
        state = _UTM_UNKNOWN
        if self._commander.armed:
            state = _UTM_GROUND if self._control["landing"]["landed"] else _UTM_AIRBORNE
        return (
            EPOCH_US + self.time_us,
            lat,
            lon,
            round(alt * 1e3),
            0,
            next_lat,
            next_lon,
            round(next_alt * 1e3),
            *[_whole(speed * 100.0, -_INT16, _INT16) for speed in self.velocity],
            _whole(1e3 * math.sqrt(variances[6] + variances[7]), 0, _UINT16),
            _whole(1e3 * math.sqrt(variances[8]), 0, _UINT16),
            _whole(1e2 * math.sqrt(sum(variances[3:6])), 0, _UINT16),
            0,
            *[0] * 18,
            state,
            flags,
        )

    def open_drone_id_location(self) -> Values:
        """Return OPEN_DRONE_ID_LOCATION: the GPS receiver's position, for remote identification."""
        s = self.sensors
        vn, ve, vd = s["gps_vel"].tolist()
        fix = int(s["gps_fix"])
        status = _ODID_GROUND if self._control["landing"]["landed"] else _ODID_AIRBORNE
        if self._commander.armed and self._commander.system_status == _CRITICAL_STATUS:
            status = _ODID_EMERGENCY
        course = round(math.degrees(math.atan2(ve, vn)) % 360.0) * 100
        return (
            round(float(s["gps_lat"]) * 1e7) if fix >= 2 else 0,
            round(float(s["gps_lon"]) * 1e7) if fix >= 2 else 0,
            float(s["baro_alt"]),
            float(round(float(s["gps_alt"]))) if fix >= 3 else _ODID_UNKNOWN_HEIGHT,
            self._height_over_home() if self._commander.home is not None else _ODID_UNKNOWN_HEIGHT,
            (EPOCH_US + self.time_us) // 1000 % _HOUR_MS / 1000.0,
            min(course, 35_999),
            _whole(100.0 * math.hypot(vn, ve), 0, 25_425),
            _whole(-100.0 * vd, -6200, 6200),
            0,
            0,
            *[0] * 20,
            status,
            0,
            _class_of(float(s["gps_eph"]), _HORIZONTAL_ACCURACY) if fix >= 2 else 0,
            _class_of(float(s["gps_epv"]), _VERTICAL_ACCURACY) if fix >= 2 else 0,
            0,
            _class_of(float(s["gps_speed_accuracy"]), _SPEED_ACCURACY),
            _ODID_SECOND,
        )

    def open_drone_id_system(self) -> Values | None:
        """Return OPEN_DRONE_ID_SYSTEM: the takeoff position as the operator's, for remote identification."""
        home = self._commander.home
        if home is None or self.sensors["gps_fix"] < 3:
            return None
        return (
            round(home.latitude * 1e7),
            round(home.longitude * 1e7),
            _ODID_UNKNOWN_HEIGHT,
            _ODID_UNKNOWN_HEIGHT,
            home.altitude,
            (EPOCH_US - _ODID_EPOCH_US + self.time_us) // 1_000_000,
            1,
            *[0] * 3,
            *[0] * 20,
            *[0] * 4,
        )


def _whole(value: float, least: int, most: int) -> int:
    """Return ``value`` clamped to ``least``..``most`` and rounded."""
    return round(min(max(value, least), most))


def silent() -> None:
    """Return None: no values for a message in ``SILENT``."""


def source(telemetry: Telemetry, name: str) -> Callable[[], Content | list[Values] | None]:
    """Return the method that returns the values or the payload of message ``name``."""
    return silent if name in SILENT else getattr(telemetry, name.lower())
