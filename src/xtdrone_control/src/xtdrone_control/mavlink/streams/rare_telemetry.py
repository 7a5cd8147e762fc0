"""Telemetry that goes out seldom, or only on request: ESCs, air traffic, links, times, what the simulator cannot know.

The fields' values are those of PX4 v1.14's streams (src/modules/mavlink/streams); Open Drone ID is ASTM F3411's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control import frames
from xtdrone_control.autopilot import modes
from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_control.autopilot.commander.manual_control import CHANNELS
from xtdrone_control.autopilot.navigator import gimbal
from xtdrone_control.autopilot.state import TASK_GOTO, TASK_LAND
from xtdrone_control.geodesy import geo
from xtdrone_control.mavlink.streams.telemetry import EPOCH_US, Telemetry, Values

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
_CRITICAL_STATUS = 5  # MAV_STATE_CRITICAL: a failsafe is on
_INT16 = 32767
_UINT16 = 65535
_UNKNOWN_TIME = -1
_FULL_SIGNAL = 100  # % of RC_CHANNELS.rssi
_NAN = math.nan
GIMBAL_DEVICE = 1  # id of a gimbal that is no MAVLink device but hangs on the autopilot
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
GIMBAL_RANGE = (0.0, 0.0, -0.5 * math.pi, 0.5 * math.pi, -math.pi, math.pi)  # rad, least and largest roll, pitch, yaw
_LASER, _DOWNWARD = 0, 25  # MAV_DISTANCE_SENSOR, MAV_SENSOR_ORIENTATION
_FLOW_SPAN_US = 20_000
_SENSOR_TIMEOUT_US = 500_000

# Streams that PX4 v1.14 has for sensors, devices and modes that are not here: intervals may be set, nothing is sent.
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
    "OBSTACLE_DISTANCE",
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
    """Return the number of the first class whose bound is over ``value``; 0 when there is none."""
    return next((number for bound, number in classes if value < bound), 0)


class Reports(Telemetry):
    """All of one vehicle's telemetry; see ``Telemetry``."""

    def __init__(self, commander: Commander, autopilot: Autopilot, index: int) -> None:
        """Look at vehicle ``index`` of ``autopilot``, whose commander is given."""
        super().__init__(commander, autopilot, index)
        self._setpoint = autopilot.setpoint[index]
        self._rotor_count = int(autopilot.rotors[index])

    # time

    def timesync(self) -> Values:
        """Ask the other end for its time (PX4 does it to measure the clocks' offset); the answer is not used."""
        return 0, self.time_us * _NANOSECONDS

    def time_estimate_to_target(self) -> Values | None:
        """Seconds that a return would take, with PX4's margins; other times are not known."""
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
        if self._control["landed"]:
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
        """Return one value a motor in batches of four, zeros where there is no motor."""
        count = self._rotor_count
        kept = [*values[:count], *[0.0] * (len(values) - count)]
        return [kept[start : start + _ESC_BATCH] for start in range(0, max(count, 1), _ESC_BATCH)]

    def esc_info(self) -> list[Values]:
        """ESCs that are all well, as warm as PX4's SITL makes them up from the motors' commands."""
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
        """Speed (revolutions a minute), voltage and current of each motor."""
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
        """Torque (normalised, FRD) and collective thrust that the allocator is asked for."""
        c = self._control
        return self.time_us, *c["sp_torque"].tolist(), float(c["sp_thrust"]), 0.0, 0.0, 0.0, 0.0, 0

    def actuator_output_status(self) -> Values:
        """Motor commands, 0..1."""
        motors = self._control["actuators"].tolist()
        return self.time_us, self._rotor_count, *motors, *[0.0] * (32 - len(motors))

    # sensors

    def vibration(self) -> Values:
        """PX4's vibration metrics; nothing clips."""
        return self.time_us, *self._estimator["vibration"].tolist(), 0, 0, 0

    def distance_sensor(self) -> Values | None:
        """The downward range finder, cm, while samples come."""
        s, quality = self.sensors, int(self.sensors["range_quality"])
        if not self._lately("time_range_us"):
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
        """Optical flow, while samples come: angles over ``_FLOW_SPAN_US`` at the rates of the last one."""
        if not self._lately("time_flow_us"):
            return None
        s, span = self.sensors, _FLOW_SPAN_US * 1e-6
        gyro = [rate * span for rate in s["flow_gyro"].tolist()]
        distance = float(s["range_distance"]) if self._lately("time_range_us") else -1.0
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

    def _lately(self, field: str) -> bool:
        """Say whether a sensor's sample, whose time the estimator keeps in ``field``, is less than 0.5 s old."""
        last = int(self._estimator[field])
        return last > 0 and self.time_us - last < _SENSOR_TIMEOUT_US

    # the gimbal, while one is fitted

    def mount_orientation(self) -> Values | None:
        """Where the gimbal points, degrees: roll and pitch from the horizon, yaw from the heading and from north."""
        attitude = self._commander.navigator.payload.gimbal_attitude
        if attitude is None:
            return None
        roll, pitch, yaw = (math.degrees(angle) for angle in attitude)
        return self.time_ms, roll, pitch, yaw, (yaw + math.degrees(self._commander.view.yaw)) % 360.0

    def gimbal_device_attitude_status(self) -> Values | None:
        """Where the gimbal points, as a quaternion; yaw from the heading, or from north when it is locked."""
        payload = self._commander.navigator.payload
        attitude = payload.gimbal_attitude
        if attitude is None:
            return None
        flags, heading = payload.gimbal_manager.flags, self._commander.view.yaw
        locked = bool(flags & gimbal.YAW_LOCK)
        roll, pitch, yaw = attitude
        q = frames.quaternion_from_rpy(roll, pitch, yaw + heading if locked else yaw)
        flags |= gimbal.YAW_IN_EARTH_FRAME if locked else gimbal.YAW_IN_VEHICLE_FRAME
        return self.time_ms, *q, _NAN, _NAN, _NAN, 0, flags, 0, 0, heading, _NAN, GIMBAL_DEVICE

    def gimbal_manager_status(self) -> Values | None:
        """Who is in control of the gimbal."""
        payload = self._commander.navigator.payload
        if payload.gimbal_attitude is None:
            return None
        manager = payload.gimbal_manager
        return self.time_ms, manager.flags, GIMBAL_DEVICE, *manager.primary, *manager.secondary

    def gimbal_manager_information(self) -> Values | None:
        """What the gimbal can do, as PX4 says it of one that is no MAVLink device."""
        if self._commander.navigator.payload.gimbal_attitude is None:
            return None
        return self.time_ms, GIMBAL_CAPABILITIES, *GIMBAL_RANGE, GIMBAL_DEVICE

    # the pilot

    def rc_channels(self) -> Values | None:
        """The radio's channels, pulse widths in us, while there is a radio."""
        manual = self._commander.manual
        channels = manual.channels
        if not channels or not manual.by_radio:
            return None
        pulses = [*channels, *[_UINT16] * (CHANNELS - len(channels))]
        return self.time_ms, *pulses, len(channels), _FULL_SIGNAL

    def manual_control(self) -> Values | None:
        """The pilot's sticks as MANUAL_CONTROL takes them, -1000..1000, and 0..1000 for the throttle."""
        sticks = self._commander.manual.sticks
        if sticks is None:
            return None
        x, y, yaw = (round(1000.0 * value) for value in (sticks.x, sticks.y, sticks.yaw))
        system = self._commander.vehicle.system_id
        return x, y, round(500.0 * (sticks.z + 1.0)), yaw, 0, system, *[0] * 10

    # where it flies to

    def _goal(self) -> list[float] | None:
        """Return the local position (m, NED) that an automatic mode flies to."""
        if not self._commander.armed or int(self._setpoint["task"]) not in (TASK_GOTO, TASK_LAND):
            return None
        goal: list[float] = self._setpoint["goal_position"].tolist()
        return goal if all(map(math.isfinite, goal)) else None

    def _place(self, position: list[float]) -> tuple[int, int, float]:
        """Return latitude and longitude in 1e-7 degrees, and altitude in m AMSL, of a local position."""
        e = self._estimator
        lat, lon = geo.reproject(position[0], position[1], float(e["origin_lat"]), float(e["origin_lon"]))
        return round(lat * 1e7), round(lon * 1e7), float(e["origin_alt"]) - position[2]

    def position_target_global_int(self) -> Values | None:
        """The place that an automatic mode flies to, with the setpoints on the way there."""
        goal = self._goal()
        if goal is None:
            return None
        c = self._control
        return (
            self.time_ms,
            *self._place(goal),
            *c["sp_velocity"].tolist(),
            *c["sp_acceleration"].tolist(),
            float(c["sp_yaw"]),
            float(c["sp_yaw_rate"]),
            0,
            _FRAME_GLOBAL_INT,
        )

    def orbit_execution_status(self) -> Values | None:
        """The circle that is flown, in ORBIT alone."""
        if self._commander.mode is not modes.ORBIT or not self._commander.armed:
            return None
        orbit = self._commander.navigator.orbit
        radius = math.copysign(orbit.radius, orbit.speed)
        goal = [*orbit.centre, float(self._setpoint["goal_position"][2])]
        latitude, longitude, altitude = self._place(goal)
        return self.time_us, radius, latitude, longitude, altitude, 0

    # air traffic

    def utm_global_position(self) -> Values | None:
        """Position for unmanned traffic management, while the place on Earth is known; altitudes are AMSL."""
        if not self._commander.view.global_valid:
            return None
        lat, lon, alt = self._place(self.position)
        goal = self._goal()
        flags = _UTM_FLAGS | (0 if goal is None else _UTM_NEXT_WAYPOINT)
        next_lat, next_lon, next_alt = (0, 0, 0.0) if goal is None else self._place(goal)
        variances = [max(value, 0.0) for value in self._variances.tolist()]
        state = _UTM_UNKNOWN
        if self._commander.armed:
            state = _UTM_GROUND if self._control["landed"] else _UTM_AIRBORNE
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
        """Remote identification: where the GPS receiver says that the vehicle is."""
        s = self.sensors
        vn, ve, vd = s["gps_vel"].tolist()
        fix = int(s["gps_fix"])
        status = _ODID_GROUND if self._control["landed"] else _ODID_AIRBORNE
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
        """Remote identification: the takeoff place stands for the operator's."""
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
    """Return ``value`` rounded and cut to ``least`` to ``most``."""
    return round(min(max(value, least), most))


def silent() -> None:
    """Give nothing: the values of a message in ``SILENT``."""


def source(telemetry: Telemetry, name: str) -> Callable[[], Values | list[Values] | None]:
    """Return the method that gives message ``name``'s values."""
    return silent if name in SILENT else getattr(telemetry, name.lower())
