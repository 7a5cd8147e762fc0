"""Topics of one vehicle published on change: status, modes, home position, setpoints of the AUTO modes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from xtdrone_autopilot.state import TASK_ATTITUDE, TASK_GOTO, TASK_LAND, TASK_RATES
from xtdrone_common import modes
from xtdrone_common.modes import Mode

from .message_definitions import message_format
from .ulog_format import Format, data_template

if TYPE_CHECKING:
    from xtdrone_autopilot.commander.commander import Commander
    from xtdrone_autopilot.commander.failsafe import Flags
    from xtdrone_autopilot.commander.manual_control import Sticks

STATUS_PERIOD_US = 500_000  # period at which PX4's commander publishes an unchanged state
_BATTERY_PERIOD_US = 200_000
_MANUAL_PERIOD_US = 200_000

_DISARMED, _ARMED = 1, 2  # vehicle_status.arming_state
_ROTARY_WING = 1
_BY_COMMAND = 4  # ARM_DISARM_REASON_COMMAND_EXTERNAL
_FROM_RADIO, _FROM_MAVLINK = 1, 2  # manual_control_setpoint.data_source
_SETPOINT_POSITION, _SETPOINT_LOITER, _SETPOINT_TAKEOFF, _SETPOINT_LAND, _SETPOINT_IDLE = 0, 2, 3, 4, 5

NAMES = [
    "vehicle_status",
    "vehicle_control_mode",
    "actuator_armed",
    "battery_status",
    "home_position",
    "position_setpoint_triplet",
    "parameter_update",
    "logger_status",
    "failsafe_flags",
    "failure_detector_status",
    "manual_control_setpoint",
    "mission_result",
    "vehicle_command",
    "vehicle_command_ack",
]
# mode masks in failsafe_flags and the corresponding entries of ``Mode.needs``
_NEEDS = (
    ("mode_req_attitude", "attitude"),
    ("mode_req_local_alt", "altitude"),
    ("mode_req_local_position", "position"),
    ("mode_req_local_position_relaxed", "relaxed_position"),
    ("mode_req_global_position", "global_position"),
    ("mode_req_mission", "mission"),
    ("mode_req_offboard_signal", "offboard"),
    ("mode_req_home_position", "home"),
)
FORMATS: dict[str, Format] = {name: message_format(name) for name in NAMES}
FILE, MAVLINK = 1, 2  # logger_status.backend


def control_flags(mode: Mode, task: int) -> dict[str, bool]:
    """Return the flags of vehicle_control_mode, after PX4 v1.14's ``getVehicleControlMode`` for a multirotor.

    Args:
        mode: flight mode.
        task: ``TASK_...`` of the setpoint, by which OFFBOARD selects its controllers.
    """
    running = mode is not modes.TERMINATION
    position = mode.needs_position and task not in (TASK_ATTITUDE, TASK_RATES)
    altitude = position or mode is modes.ALTCTL
    climb_rate = altitude or mode is modes.DESCEND
    return {
        "flag_control_manual_enabled": mode.sticks,
        "flag_control_auto_enabled": mode.main == modes.MAIN_AUTO and mode is not modes.AUTO_FOLLOW_TARGET,
        "flag_control_offboard_enabled": mode is modes.OFFBOARD,
        "flag_control_termination_enabled": not running,
        "flag_control_rates_enabled": running,
        "flag_control_attitude_enabled": running and mode is not modes.ACRO and task != TASK_RATES,
        "flag_control_velocity_enabled": position,
        "flag_control_position_enabled": position,
        "flag_control_altitude_enabled": altitude,
        "flag_control_climb_rate_enabled": climb_rate,
        "flag_multicopter_position_control_enabled": climb_rate,
    }


class StatusTopics:
    """Encoder of the status messages of one vehicle."""

    def __init__(self, commander: Commander, ids: dict[str, int], backend: int = FILE) -> None:
        """Create the message templates.

        Args:
            commander: the vehicle's commander.
            ids: message id of each topic.
            backend: destination of the log, ``FILE`` or ``MAVLINK``.
        """
        self._commander = commander
        self._backend = backend
        self._messages = {name: data_template(FORMATS[name], ids[name]) for name in NAMES}
        self._records: dict[str, Any] = {name: message["record"] for name, message in self._messages.items()}
        for mask, need in _NEEDS:
            self._records["failsafe_flags"][mask] = sum(1 << mode.state for mode in modes.ALL if need in mode.needs)
        self._out: list[bytes] = []
        self._turn = False
        self._state: tuple[Any, ...] = ()
        self._home: Any = None
        self._goal: tuple[Any, ...] = ()
        self._mission: tuple[Any, ...] = ()
        self._mission_count = 0
        self._home_count = 0
        self._parameter_count = 0
        self._status_due_us = self._battery_due_us = self._manual_due_us = 0
        self._armed_us = self._took_off_us = self._nav_state_us = 0

    def take(self) -> bytes:
        """Return the encoded messages since the last call."""
        data = b"".join(self._out)
        self._out.clear()
        return data

    def _emit(self, name: str, now_us: int) -> None:
        record = self._records[name]
        # timestamps of a topic must increase, but two commands may arrive in the same step
        record["timestamp"] = max(now_us, int(record["timestamp"]) + 1)
        self._out.append(self._messages[name].tobytes())

    def restart(self) -> None:
        """Publish all topics again, for a new log."""
        self._out.clear()
        self._turn = False
        self._state = self._goal = self._mission = ()
        self._home = None
        self._status_due_us = self._battery_due_us = self._manual_due_us = 0

    def update(self, now_us: int) -> None:
        """Publish topics that are due or have changed; call at 10 Hz. Slow topics are checked on every other call."""
        c = self._commander
        state = (c.armed, c.mode, c.failsafe, c.view.landed, c.health.flags)
        if state != self._state:
            self._record_times(state, now_us)
            self._publish_state(now_us)
        elif now_us >= self._status_due_us:
            self._publish_state(now_us)
        self._turn = not self._turn
        if self._turn:
            self._update_slowly(now_us)

    def _update_slowly(self, now_us: int) -> None:
        c = self._commander
        if now_us >= self._battery_due_us:
            self._publish_battery(now_us)
        if now_us >= self._manual_due_us and c.manual.sticks is not None:
            self._publish_sticks(c.manual.sticks, now_us)
        mission = c.navigator.mission
        if (mission.reached, mission.plans.current, mission.plans.changes[0]) != self._mission:
            self._publish_mission(now_us)
        if c.home is not self._home:
            self._publish_home(now_us)
        goal = self._current_goal()
        if goal != self._goal:
            self._goal = goal
            self._publish_goal(now_us)

    def _record_times(self, state: tuple[Any, ...], now_us: int) -> None:
        armed, mode, _, landed, _ = state
        before = self._state or (False, None, None, True, None)
        if armed and not before[0]:
            self._armed_us, self._took_off_us = now_us, 0
        if not armed:
            self._armed_us = self._took_off_us = 0
        if before[3] and not landed:
            self._took_off_us = now_us
        if mode is not before[1]:
            self._nav_state_us = now_us
        self._state = state

    def _publish_state(self, now_us: int) -> None:
        self._status_due_us = now_us + STATUS_PERIOD_US
        c = self._commander
        mode = c.mode
        status = self._records["vehicle_status"]
        status["armed_time"] = self._armed_us
        status["takeoff_time"] = self._took_off_us
        status["arming_state"] = _ARMED if c.armed else _DISARMED
        status["latest_arming_reason"] = _BY_COMMAND if c.armed else 0
        status["nav_state_timestamp"] = self._nav_state_us
        status["nav_state"] = mode.state
        status["nav_state_user_intention"] = c.requested_mode.state
        status["vehicle_type"] = _ROTARY_WING
        status["failsafe"] = c.failsafe
        status["system_type"] = int(c.parameters.get("MAV_TYPE")) & 0xFF
        status["system_id"] = c.vehicle.system_id
        status["component_id"] = 1
        status["power_input_valid"] = True
        status["pre_flight_checks_pass"] = c.armed or c.ready_to_arm
        self._emit("vehicle_status", now_us)
        self._publish_control_mode(mode, now_us)
        armed = self._records["actuator_armed"]
        armed["armed"] = c.armed
        armed["ready_to_arm"] = status["pre_flight_checks_pass"]
        self._emit("actuator_armed", now_us)
        self._publish_failsafe_flags(c.health.flags, now_us)
        detector, r = c.health.detector, self._records["failure_detector_status"]
        r["fd_roll"], r["fd_pitch"], r["fd_motor"] = detector.roll, detector.pitch, bool(detector.motors)
        r["motor_failure_mask"] = sum(1 << motor for motor in detector.motors)
        self._emit("failure_detector_status", now_us)

    def _publish_failsafe_flags(self, flags: Flags, now_us: int) -> None:
        r = self._records["failsafe_flags"]
        r["attitude_invalid"] = r["angular_velocity_invalid"] = flags.attitude_invalid
        r["local_altitude_invalid"] = flags.altitude_invalid
        r["local_position_invalid"] = flags.position_invalid
        r["global_position_invalid"] = flags.global_position_invalid
        r["local_position_invalid_relaxed"] = r["local_velocity_invalid"] = flags.relaxed_position_invalid
        r["home_position_invalid"] = flags.home_missing
        r["auto_mission_missing"] = flags.mission_missing
        r["offboard_control_signal_lost"] = flags.offboard_lost
        r["manual_control_signal_lost"] = flags.manual_lost
        r["gcs_connection_lost"] = flags.gcs_lost
        r["primary_geofence_breached"] = flags.geofence
        r["battery_warning"] = flags.battery
        r["battery_unhealthy"] = flags.battery_unhealthy
        r["fd_critical_failure"] = flags.attitude_failure
        r["fd_motor_failure"] = flags.motor_failure
        r["flight_time_limit_exceeded"] = flags.flight_time_exceeded
        self._emit("failsafe_flags", now_us)

    def _publish_control_mode(self, mode: Mode, now_us: int) -> None:
        r = self._records["vehicle_control_mode"]
        r["flag_armed"] = self._commander.armed
        for name, enabled in control_flags(mode, int(self._commander.view.setpoint["task"])).items():
            r[name] = enabled
        self._emit("vehicle_control_mode", now_us)

    def _publish_battery(self, now_us: int) -> None:
        self._battery_due_us = now_us + _BATTERY_PERIOD_US
        battery = self._commander.battery
        r = self._records["battery_status"]
        r["connected"] = battery.connected
        r["voltage_v"] = r["voltage_filtered_v"] = battery.voltage
        r["current_a"] = r["current_average_a"] = battery.current
        r["discharged_mah"] = battery.discharged
        r["remaining"] = battery.remaining
        r["scale"] = 1.0
        r["time_remaining_s"] = battery.time_remaining
        r["temperature"] = math.nan
        r["cell_count"] = int(self._commander.parameters.get("BAT1_N_CELLS"))
        r["id"] = 1
        r["warning"] = battery.warning
        self._emit("battery_status", now_us)

    def _publish_sticks(self, sticks: Sticks, now_us: int) -> None:
        self._manual_due_us = now_us + _MANUAL_PERIOD_US
        c = self._commander
        r = self._records["manual_control_setpoint"]
        r["timestamp_sample"] = now_us
        r["valid"] = True
        r["data_source"] = _FROM_RADIO if c.manual.by_radio else _FROM_MAVLINK
        r["pitch"], r["roll"], r["throttle"], r["yaw"] = sticks
        r["sticks_moving"] = c.manual.moving
        self._emit("manual_control_setpoint", now_us)

    def _publish_mission(self, now_us: int) -> None:
        mission = self._commander.navigator.mission
        plans = mission.plans
        self._mission = (mission.reached, plans.current, plans.changes[0])
        self._mission_count += 1
        r = self._records["mission_result"]
        r["instance_count"] = self._mission_count
        r["seq_reached"], r["seq_current"], r["seq_total"] = mission.reached, plans.current, len(plans.mission)
        r["valid"] = bool(plans.mission)
        r["finished"] = bool(plans.mission) and mission.reached == len(plans.mission) - 1
        self._emit("mission_result", now_us)

    def _publish_home(self, now_us: int) -> None:
        home = self._home = self._commander.home
        if home is None:
            return
        self._home_count += 1
        r = self._records["home_position"]
        r["lat"], r["lon"], r["alt"] = home.latitude, home.longitude, home.altitude
        r["x"], r["y"], r["z"] = home.position
        r["yaw"] = home.yaw
        r["valid_alt"] = r["valid_hpos"] = r["valid_lpos"] = True
        r["update_count"] = self._home_count
        self._emit("home_position", now_us)

    # setpoints of the AUTO modes

    def _current_goal(self) -> tuple[Any, ...]:
        c = self._commander
        task = int(c.view.setpoint["task"])
        if not c.armed or task not in (TASK_GOTO, TASK_LAND):
            return (c.armed and task,)
        s = c.view.setpoint
        return (task, c.mode, s["goal_position"].tobytes(), s["goal_yaw"].tobytes(), s["cruise_speed"].tobytes())

    def _publish_goal(self, now_us: int) -> None:
        c = self._commander
        r = self._records["position_setpoint_triplet"]
        r["previous"] = r["current"]
        current = r["current"]
        current["timestamp"] = now_us
        s = c.view.setpoint
        if len(self._goal) == 1:
            current["valid"] = False
            current["type"] = _SETPOINT_IDLE
        else:
            goal = s["goal_position"].tolist()
            here = c.view.position
            position = tuple(h if math.isnan(g) else g for g, h in zip(goal, here, strict=True))
            if c.view.has_origin:
                current["lat"], current["lon"], current["alt"] = c.view.to_global(
                    (position[0], position[1], position[2])
                )
            current["valid"] = True
            current["type"] = self._goal_type(int(s["task"]))
            current["yaw"] = s["goal_yaw"]
            current["yaw_valid"] = bool(np.isfinite(s["goal_yaw"]))
            current["cruising_speed"] = -1.0 if np.isnan(s["cruise_speed"]) else s["cruise_speed"]
            current["acceptance_radius"] = c.parameters.get("NAV_ACC_RAD")
        self._emit("position_setpoint_triplet", now_us)

    def _goal_type(self, task: int) -> int:
        if task == TASK_LAND:
            return _SETPOINT_LAND
        mode = self._commander.mode
        if mode is modes.AUTO_TAKEOFF:
            return _SETPOINT_TAKEOFF
        return _SETPOINT_LOITER if mode is modes.AUTO_LOITER else _SETPOINT_POSITION

    # notifications

    def parameter_changed(self, now_us: int) -> None:
        """Publish a parameter change."""
        self._parameter_count += 1
        r = self._records["parameter_update"]
        r["instance"] = r["set_count"] = self._parameter_count
        self._emit("parameter_update", now_us)

    def command(
        self, number: int, params: Sequence[float], sender: tuple[int, int], result: int | None, now_us: int
    ) -> None:
        """Publish a MAV_CMD from ``sender`` (system, component) and its acknowledgement, if it was answered."""
        system = self._commander.vehicle.system_id
        r = self._records["vehicle_command"]
        for i, value in enumerate(params, 1):
            r[f"param{i}"] = value
        r["command"], r["target_system"], r["target_component"] = number, system, 1
        r["source_system"], r["source_component"] = sender
        r["from_external"] = True
        self._emit("vehicle_command", now_us)
        if result is None:
            return
        r = self._records["vehicle_command_ack"]
        r["command"], r["result"] = number, int(result)
        r["target_system"], r["target_component"] = sender
        r["from_external"] = True
        self._emit("vehicle_command_ack", now_us)

    def written(self, kilobytes: float, rate: float, now_us: int) -> None:
        """Publish the size of the log, kB, and its current write rate, kB/s."""
        r = self._records["logger_status"]
        r["backend"] = self._backend
        r["total_written_kb"], r["write_rate_kb_s"] = kilobytes, rate
        r["num_messages"] = len(NAMES)
        self._emit("logger_status", now_us)
