"""Telemetry of the navigation: target, orbit, obstacles, time, and remote identification.

Field values are those of PX4 v1.14's streams; Open Drone ID is ASTM F3411's.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.flight_tasks.obstacle_map import FORWARD_FRAME
from xtdrone_autopilot.mavlink.streams.vehicle_state import EPOCH_US, Values, VehicleState, round_within
from xtdrone_autopilot.state import OBSTACLE_BINS, TASK_GOTO, TASK_LAND
from xtdrone_common import modes
from xtdrone_common.geodesy import projection

_NANOSECONDS = 1000  # a microsecond
_FRAME_GLOBAL_INT = 5
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
_OBSTACLE_DISTANCES = 72  # in OBSTACLE_DISTANCE


def _class_of(value: float, classes: tuple[tuple[float, int], ...]) -> int:
    """Return the number of the first class with a bound above ``value``; 0 if no bound is."""
    return next((number for bound, number in classes if value < bound), 0)


class NavigationTelemetry:
    """Messages on where one vehicle flies; the name of a method is that of its message in lower case."""

    def __init__(self, vehicle: VehicleState) -> None:
        """Build the messages from ``vehicle``."""
        self._vehicle = vehicle

    def timesync(self) -> Values:
        """Return TIMESYNC, with which PX4 measures the offset of the clocks; the reply is ignored."""
        return 0, self._vehicle.time_us * _NANOSECONDS

    def time_estimate_to_target(self) -> Values | None:
        """Return TIME_ESTIMATE_TO_TARGET: time of a return, s, with PX4's margins; the other times are unknown."""
        seconds = self._return_time()
        if seconds is None:
            return None
        return round(seconds), _UNKNOWN_TIME, _UNKNOWN_TIME, _UNKNOWN_TIME, _UNKNOWN_TIME

    def _return_time(self) -> float | None:
        home = self._vehicle.commander.home
        if home is None or not self._vehicle.located:
            return None
        get = self._vehicle.commander.parameters.get
        height = self._vehicle.height_over_home()
        (x, y, _), place = self._vehicle.position, home.position
        distance = math.hypot(x - place[0], y - place[1])
        if self._vehicle.control["landing"]["landed"]:
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

    def _goal(self) -> list[float] | None:
        """Return the target of the automatic mode, local position (m, NED); None in other modes."""
        if not self._vehicle.commander.armed or int(self._vehicle.setpoint["task"]) not in (TASK_GOTO, TASK_LAND):
            return None
        goal: list[float] = self._vehicle.setpoint["goal_position"].tolist()
        return goal if all(map(math.isfinite, goal)) else None

    def _global_position(self, position: list[float]) -> tuple[int, int, float]:
        """Return latitude and longitude in 1e-7 degrees, and altitude in m AMSL, of a local position."""
        e = self._vehicle.estimator
        lat, lon = projection.reproject(position[0], position[1], float(e["origin"]["lat"]), float(e["origin"]["lon"]))
        return round(lat * 1e7), round(lon * 1e7), float(e["origin"]["alt"]) - position[2]

    def position_target_global_int(self) -> Values | None:
        """Return POSITION_TARGET_GLOBAL_INT: target of the automatic mode and the current trajectory setpoint."""
        goal = self._goal()
        if goal is None:
            return None
        c = self._vehicle.control
        motion = *c["sp_velocity"].tolist(), *c["sp_acceleration"].tolist(), float(c["sp_yaw"]), float(c["sp_yaw_rate"])
        return self._vehicle.time_ms, *self._global_position(goal), *motion, 0, _FRAME_GLOBAL_INT

    def orbit_execution_status(self) -> Values | None:
        """Return ORBIT_EXECUTION_STATUS: the circle being flown; None outside ORBIT."""
        if self._vehicle.commander.mode is not modes.ORBIT or not self._vehicle.commander.armed:
            return None
        orbit = self._vehicle.commander.navigator.orbit
        radius = math.copysign(orbit.radius, orbit.speed)
        goal = [*orbit.centre, float(self._vehicle.setpoint["goal_position"][2])]
        latitude, longitude, altitude = self._global_position(goal)
        return self._vehicle.time_us, radius, latitude, longitude, altitude, 0

    def obstacle_distance(self) -> Values | None:
        """Return OBSTACLE_DISTANCE: collision prevention's map, clockwise from the nose, while it is in use."""
        found = self._vehicle.control["obstacles"]
        commander = self._vehicle.commander
        in_use = commander.armed and commander.mode is modes.POSCTL and found["active_us"] >= 0
        if not in_use or commander.parameters.get("CP_DIST") <= 0.0:
            return None
        distances = [int(value) for value in found["distances"]]
        distances += [_UINT16] * (_OBSTACLE_DISTANCES - len(distances))
        least, largest = int(found["least"]), int(found["largest"])
        time_us, width = int(found["time_us"]), 360.0 / OBSTACLE_BINS
        return time_us, *distances, least, largest, 0, 0, width, 0.0, FORWARD_FRAME

    def utm_global_position(self) -> Values | None:
        """Return UTM_GLOBAL_POSITION while the global position is valid; altitudes in mm AMSL."""
        if not self._vehicle.commander.view.global_valid:
            return None
        lat, lon, alt = self._global_position(self._vehicle.position)
        goal = self._goal()
        flags = _UTM_FLAGS | (0 if goal is None else _UTM_NEXT_WAYPOINT)
        next_lat, next_lon, next_alt = (0, 0, 0.0) if goal is None else self._global_position(goal)
        places = lat, lon, round(alt * 1e3), 0, next_lat, next_lon, round(next_alt * 1e3)
        speeds = [round_within(speed * 100.0, -_INT16, _INT16) for speed in self._vehicle.velocity]
        variances = [max(value, 0.0) for value in self._vehicle.variances.tolist()]
        horizontal, vertical = math.sqrt(variances[6] + variances[7]), math.sqrt(variances[8])
        errors = 1e3 * horizontal, 1e3 * vertical, 1e2 * math.sqrt(sum(variances[3:6]))
        accuracies = [round_within(error, 0, _UINT16) for error in errors]
        state = _UTM_UNKNOWN
        if self._vehicle.commander.armed:
            state = _UTM_GROUND if self._vehicle.control["landing"]["landed"] else _UTM_AIRBORNE
        return EPOCH_US + self._vehicle.time_us, *places, *speeds, *accuracies, 0, *[0] * 18, state, flags

    def open_drone_id_location(self) -> Values:
        """Return OPEN_DRONE_ID_LOCATION: the GPS receiver's position, for remote identification."""
        s = self._vehicle.sensors
        vn, ve, vd = s["gps_vel"].tolist()
        fix = int(s["gps_fix"])
        status = _ODID_GROUND if self._vehicle.control["landing"]["landed"] else _ODID_AIRBORNE
        if self._vehicle.commander.armed and self._vehicle.commander.system_status == _CRITICAL_STATUS:
            status = _ODID_EMERGENCY
        course = round(math.degrees(math.atan2(ve, vn)) % 360.0) * 100
        place = [round(float(s[f"gps_{name}"]) * 1e7) if fix >= 2 else 0 for name in ("lat", "lon")]
        altitude = float(round(float(s["gps_alt"]))) if fix >= 3 else _ODID_UNKNOWN_HEIGHT
        has_home = self._vehicle.commander.home is not None
        height = self._vehicle.height_over_home() if has_home else _ODID_UNKNOWN_HEIGHT
        time = (EPOCH_US + self._vehicle.time_us) // 1000 % _HOUR_MS / 1000.0
        speeds = round_within(100.0 * math.hypot(vn, ve), 0, 25_425), round_within(-100.0 * vd, -6200, 6200)
        horizontal = _class_of(float(s["gps_eph"]), _HORIZONTAL_ACCURACY) if fix >= 2 else 0
        vertical = _class_of(float(s["gps_epv"]), _VERTICAL_ACCURACY) if fix >= 2 else 0
        accuracies = horizontal, vertical, 0, _class_of(float(s["gps_speed_accuracy"]), _SPEED_ACCURACY), _ODID_SECOND
        motion = time, min(course, 35_999), *speeds
        return *place, float(s["baro_alt"]), altitude, height, *motion, 0, 0, *[0] * 20, status, 0, *accuracies

    def open_drone_id_system(self) -> Values | None:
        """Return OPEN_DRONE_ID_SYSTEM: the takeoff position as the operator's, for remote identification."""
        home = self._vehicle.commander.home
        if home is None or self._vehicle.sensors["gps_fix"] < 3:
            return None
        place = round(home.latitude * 1e7), round(home.longitude * 1e7)
        time = (EPOCH_US - _ODID_EPOCH_US + self._vehicle.time_us) // 1_000_000
        return *place, _ODID_UNKNOWN_HEIGHT, _ODID_UNKNOWN_HEIGHT, home.altitude, time, 1, *[0] * 27
