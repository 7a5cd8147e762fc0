"""Catalogue of the autopilot's events: their arguments, and their messages for ground stations.

Names, which determine the event numbers, types and order of the arguments, and the texts of the arming checks are PX4
v1.14's; the other messages are written for this project. They have libevents' notation: ``{2}`` is the second argument,
``{1:.1m_v}`` the first as a height with one decimal.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

CODES = {
    "uint8_t": "B",
    "int8_t": "b",
    "uint16_t": "H",
    "int16_t": "h",
    "uint32_t": "I",
    "int32_t": "i",
    "float": "f",
}
ENUM_TYPES = {
    "navigation_mode_group_t": "uint32_t",
    "health_component_t": "uint32_t",
    "navigation_mode_t": "uint8_t",
    "failsafe_action_t": "uint8_t",
    "failsafe_cause_t": "uint8_t",
    "arm_disarm_reason_t": "uint8_t",
}
DEFAULT, ARMING_CHECK, HEALTH = "default", "arming_check", "health"
MAX_ARGUMENTS = 25  # bytes of arguments in PX4's event.msg

_SUMMARY = "summary"
WITH_CHECKS = "append_health_and_arming_messages"  # the ground station appends the failed checks of the mode


@dataclass(frozen=True)
class Definition:
    """Definition of an event.

    Attributes:
        name: PX4's name.
        message: message text.
        arguments: (name, type) of each argument.
        group: libevents' group: "default", "arming_check" or "health".
        kind: libevents' type within the group, empty for none.
        description: additional text, empty for none.
        layout: binary layout of the arguments.
    """

    name: str
    message: str
    arguments: tuple[tuple[str, str], ...]
    group: str
    kind: str
    description: str
    layout: struct.Struct


def _define(
    name: str, message: str, arguments: str = "", group: str = DEFAULT, kind: str = "", description: str = ""
) -> Definition:
    """Return a definition; ``arguments`` are ``name:type``, separated by spaces.

    Raises:
        ValueError: the arguments exceed MAX_ARGUMENTS bytes.
    """
    fields = [part.split(":") for part in arguments.split()]
    parsed = tuple((label, of_type) for label, of_type in fields)
    layout = struct.Struct("<" + "".join(CODES[ENUM_TYPES.get(of_type, of_type)] for _, of_type in parsed))
    if layout.size > MAX_ARGUMENTS:
        raise ValueError(f"event {name}: {layout.size} bytes of arguments, at most {MAX_ARGUMENTS} are allowed")
    return Definition(name, message, parsed, group, kind, description, layout)


def _check(name: str, message: str, description: str = "") -> Definition:
    arguments = "modes:navigation_mode_group_t health_component_index:uint8_t"
    return _define(name, message, arguments, ARMING_CHECK, description=description)


_COMMANDER = (
    _define("commander_armed_by", "Armed by {1}", "reason:arm_disarm_reason_t"),
    _define("commander_disarmed_by", "Disarmed by {1}", "reason:arm_disarm_reason_t"),
    _define("commander_mission_start_denied_no_mission", "Mission start denied: no valid mission"),
    _define(
        "commander_arm_denied_throttle_high",
        "Arming denied: high throttle",
        description="In a mode in which the stick sets the thrust, the throttle must be down.",
    ),
    _define(
        "commander_arm_denied_throttle_center",
        "Arming denied: throttle above centre",
        description="The vehicle would climb at once.",
    ),
    _define(
        "commander_arm_denied_not_manual",
        "Arming denied: choose a manual mode first",
        description="By stick, switch or button the vehicle is armed only in a mode that is flown by hand.",
    ),
    _define("commander_disarming_denied_not_landed", "Disarming denied, the vehicle has not landed"),
    _define("commander_kill_sw_engaged", "Kill engaged: the motors are stopped"),
    _define("commander_kill_sw_disengaged", "Kill disengaged"),
    _define("commander_unsupported_auto_mode", "Unsupported AUTO mode"),
    _define(
        "commander_modeswitch_not_avail",
        "Switching to {2} is not possible now",
        "mode:uint32_t requested:navigation_mode_t",
        kind=WITH_CHECKS,
    ),
    _define("commander_cal_cmd_denied", "Command {1} is denied during a calibration", "command:uint32_t"),
    _define("commander_rc_override", "Pilot took over with the sticks"),
    _define("failsafe_rc_override", "Pilot took over with the sticks, the failsafe has ended"),
    _define("commander_landing_current_pos", "Landing at the current position"),
    _define("commander_landing_prec_land", "Landing on a target"),
    _define("commander_rtl", "Returning to launch"),
    _define("commander_takeoff_detected", "Takeoff detected"),
    _define("commander_landing_detected", "Landing detected"),
    _define("commander_gcs_lost", "Connection to the ground station lost"),
    _define("commander_dl_regained", "Connection to the ground station regained"),
    _define("commander_rc_lost", "Manual control lost"),
    _define("commander_rc_regained", "Manual control regained after {1:.1} s", "lost_for:float"),
    _define(
        "commander_failsafe_enter",
        "Failsafe because of {3}: {2}",
        "mode:uint32_t action:failsafe_action_t cause:failsafe_cause_t",
    ),
    _define(
        "commander_failsafe_enter_generic",
        "Failsafe: {2}",
        "mode:uint32_t action:failsafe_action_t",
        kind=WITH_CHECKS,
    ),
    _define(
        "commander_failsafe_enter_hold",
        "Failsafe because of {4}: {2} in {3} s",
        "mode:uint32_t action:failsafe_action_t delay:uint16_t cause:failsafe_cause_t",
        description="The vehicle holds its position until then; the pilot can take over.",
    ),
    _define(
        "commander_failsafe_enter_generic_hold",
        "Failsafe: {2} in {3} s",
        "mode:uint32_t action:failsafe_action_t delay:uint16_t",
        kind=WITH_CHECKS,
        description="The vehicle holds its position until then; the pilot can take over.",
    ),
    _define(
        "commander_failsafe_enter_warn",
        "Failsafe warning: {2}",
        "mode:uint32_t cause:failsafe_cause_t",
        description="The vehicle continues.",
    ),
    _define(
        "commander_failsafe_enter_generic_warn",
        "Failsafe warning",
        "mode:uint32_t",
        kind=WITH_CHECKS,
        description="The vehicle continues.",
    ),
    _define("commander_failsafe_enter_low_bat", "Low battery, return is advised"),
    _define("commander_failsafe_enter_crit_bat_warn", "Critical battery, landing is advised"),
    _define("commander_failsafe_enter_crit_low_bat_warn", "Battery almost empty, land at once"),
)

_CHECKS = (
    _define(
        "commander_arming_check_summary",
        "Summary of the arming checks",
        "chunk_idx:uint8_t error:health_component_t warning:health_component_t"
        " can_arm:navigation_mode_group_t can_run:navigation_mode_group_t",
        ARMING_CHECK,
        _SUMMARY,
    ),
    _define(
        "commander_health_summary",
        "Summary of the vehicle's health",
        "chunk_idx:uint8_t is_present:health_component_t error:health_component_t warning:health_component_t",
        HEALTH,
        _SUMMARY,
    ),
    _check("check_modes_cannot_takeoff", "Mode not suitable for arming", "Choose another mode before arming."),
    _check("check_modes_attitude", "No valid attitude estimate", "Wait until the estimator has started."),
    _check("check_modes_local_pos", "No valid local position estimate"),
    _check(
        "check_modes_global_pos",
        "No valid global position estimate",
        "The mode needs GPS, or an origin of the local frame (SET_GPS_GLOBAL_ORIGIN).",
    ),
    _check("check_modes_local_alt", "No valid altitude estimate"),
    _check("check_modes_mission", "No valid mission available", "Upload one that can be flown."),
    _check(
        "check_modes_offboard_signal",
        "No offboard signal",
        "The mode needs a stream of setpoints; <param>COM_OF_LOSS_T</param> is the timeout.",
    ),
    _check("check_modes_home_position", "Home position not set"),
    _check("check_modes_manual_control", "No manual control input", "Connect a joystick or a radio."),
    _check("check_battery_unhealthy", "Battery unhealthy"),
    _check("check_battery_low", "Low battery"),
    _check("check_battery_critical", "Critical battery"),
    _check("check_battery_emergency", "Emergency battery level"),
    _check(
        "check_rc_dl_no_dllink",
        "No connection to the ground control station",
        "Required by <param>NAV_DLL_ACT</param>.",
    ),
    _check(
        "check_failure_detector_attitude",
        "Attitude failure detected",
        "The limits are <param>FD_FAIL_R</param> and <param>FD_FAIL_P</param>.",
    ),
    _check("check_failure_detector_motor", "Motor failure detected"),
    _check("check_gf_violation", "Geofence violation"),
    _check(
        "check_estimator_vel_not_stable",
        "Velocity estimate not stable",
        "Its innovations are larger than <param>COM_ARM_EKF_VEL</param> allows.",
    ),
    _check(
        "check_estimator_pos_not_stable",
        "Position estimate not stable",
        "Its innovations are larger than <param>COM_ARM_EKF_POS</param> allows.",
    ),
    _check(
        "check_estimator_hgt_not_stable",
        "Height estimate not stable",
        "Its innovations are larger than <param>COM_ARM_EKF_HGT</param> allows.",
    ),
    _check(
        "check_estimator_heading_not_stable",
        "Heading estimate not stable",
        "Its innovations are larger than <param>COM_ARM_EKF_YAW</param> allows.",
    ),
    _check("check_estimator_gps_fix_too_low", "GPS fix too low"),
)

_CONTROL = (
    _define("col_prev_unsup_frame", "Obstacle distances in frame {1} are not supported", "frame:uint8_t"),
    *(
        _define(f"ekf2_aid_mask_{part}", f"Use {name} instead of EKF2_AID_MASK, set to {{1:.0}}", "value:float")
        for part, name in (
            ("gps", "EKF2_GPS_CTRL"),
            ("opt_flow", "EKF2_OF_CTRL"),
            ("ev", "EKF2_EV_CTRL"),
            ("imu", "EKF2_IMU_CTRL"),
        )
    ),
    _define("mc_pos_ctrl_tilt_set", "MPC_TILTMAX_AIR is too large, set to {1:.0}", "degrees:float"),
    _define("mc_pos_ctrl_land_tilt_set", "MPC_TILTMAX_LND exceeds MPC_TILTMAX_AIR, set to {1:.0}", "degrees:float"),
    _define("mc_pos_ctrl_cruise_set", "MPC_XY_CRUISE exceeds MPC_XY_VEL_MAX, set to {1:.0}", "speed:float"),
    _define("mc_pos_ctrl_man_vel_set", "MPC_VEL_MANUAL exceeds MPC_XY_VEL_MAX, set to {1:.0}", "speed:float"),
    _define("mc_pos_ctrl_man_vel_back_set", "MPC_VEL_MAN_BACK exceeds MPC_VEL_MANUAL, set to {1:.0}", "speed:float"),
    _define("mc_pos_ctrl_man_vel_side_set", "MPC_VEL_MAN_SIDE exceeds MPC_VEL_MANUAL, set to {1:.0}", "speed:float"),
    _define("mc_pos_ctrl_up_vel_set", "MPC_Z_V_AUTO_UP exceeds MPC_Z_VEL_MAX_UP, set to {1:.0}", "speed:float"),
    _define("mc_pos_ctrl_down_vel_set", "MPC_Z_V_AUTO_DN exceeds MPC_Z_VEL_MAX_DN, set to {1:.0}", "speed:float"),
    _define("mc_pos_ctrl_hover_thrust_set", "MPC_THR_HOVER is out of its limits, set to {1:.0}", "thrust:float"),
)

_NAVIGATOR = (
    _define("navigator_rtl_mission_activated", "Return: the mission goes on to its landing"),
    _define("navigator_rtl_mission_activated_rev", "Return: the mission is flown in reverse"),
    _define("navigator_rtl_mission_activated_home", "Return: flying home"),
    _define("mission_finished_rev", "Mission in reverse finished, landed"),
    _define("mission_finished_rev_loiter", "Mission in reverse finished, holding"),
    _define("navigator_rtl_home_activated", "Return activated"),
    _define("orbit_radius_exceeded", "The orbit's radius is outside its limits"),
    _define("navigator_reposition_outside_geofence", "Reposition rejected: outside the geofence"),
    _define("navigator_takeoff_min_alt", "Taking off to the minimum height, {1:.2m_v}", "height:float"),
    _define("navigator_takeoff_already_higher", "Already above the takeoff height, not descending"),
    _define("rtl_land_at_home", "Return: landing at home"),
    _define("rtl_land_at_mission", "Return: landing where the mission lands"),
    _define("rtl_land_at_safe_point", "Return: landing at a rally point"),
    _define("rtl_climb_to", "Return: climbing to {1m_v}, {2m_v} over its end", "altitude:int32_t height:int32_t"),
    _define("rtl_return_at", "Return: flying at {1m_v}, {2m_v} over its end", "altitude:int32_t height:int32_t"),
    _define("rtl_descend_to", "Return: descending to {1m_v}, {2m_v} over its end", "altitude:int32_t height:int32_t"),
    _define("rtl_loiter", "Return: waiting for {1:.1} s", "time:float"),
    _define("rtl_completed_loiter", "Return completed, holding"),
    _define("rtl_land_at_destination", "Return: landing"),
    _define("mission_finished", "Mission finished, landed"),
    _define("mission_finished_loiter", "Mission finished, holding"),
    _define("mission_not_valid_refuse", "No valid mission available, no takeoff"),
    _define("mission_not_valid_loiter", "No valid mission available, holding"),
    _define("mission_takeoff_to", "Takeoff to {1:.1m_v} over home", "height:float"),
    _define("navigator_mission_failure_heading", "Mission failed: an item's heading is not reached in time"),
    _define("mission_do_jump_cycle", "The mission's jumps form a loop"),
    _define("mission_do_jump_rep_completed", "All repetitions of a jump are completed"),
    _define(
        "mission_index_out_of_bound",
        "Mission item {1} does not exist, there are {2}",
        "index:uint16_t count:uint16_t",
    ),
    _define("navigator_mis_no_home_rel_alt", "Mission rejected: waypoint {1} needs a home", "item:int16_t"),
    _define("navigator_mis_unsup_cmd", "Mission rejected: item {1} has command {2}", "item:uint16_t command:uint16_t"),
    _define("navigator_mis_starts_w_landing", "Mission rejected: it begins with a landing"),
    _define("navigator_mis_wp_below_home", "Waypoint {1} is below home", "item:int16_t"),
    _define(
        "navigator_mis_wp_gate_too_close",
        "Mission rejected: {1:.3m} between waypoint and gate, {2:.3m} is the minimum",
        "distance:float least:float",
    ),
    _define(
        "navigator_mis_first_wp_too_far",
        "Mission rejected: first waypoint {1m} away, at most {2m}",
        "distance:uint32_t most:uint32_t",
        description="<param>MIS_DIST_1WP</param> is the limit.",
    ),
    _define("navigator_mis_takeoff_too_low", "Mission rejected: takeoff below {1:.1m_v}", "least:float"),
    _define("navigator_mis_takeoff_not_first", "Mission rejected: the takeoff is not its first waypoint"),
    _define("navigator_mis_vtol", "Mission rejected: it has VTOL items, the vehicle is a multirotor"),
    _define("navigator_mis_takeoff_missing", "Mission rejected: it has no takeoff"),
    _define("navigator_mis_land_missing", "Mission rejected: it has no landing"),
    _define("navigator_mis_takeoff_or_land_missing", "Mission rejected: takeoff or landing is missing"),
    _define("navigator_mis_add_land_or_rm_to", "Mission rejected: it has a takeoff but no landing"),
    _define("navigator_mis_add_to_or_rm_land", "Mission rejected: it has a landing but no takeoff"),
    _define("navigator_mis_geofence_violation", "Mission rejected: waypoint {1} is out of bounds", "item:int16_t"),
)

_TRANSFER = (
    _define("mavlink_mission_op_timeout", "Mission transfer ended: timeout"),
    _define("mavlink_mission_req_ignored", "Mission download rejected: another is running"),
    _define("mavlink_mission_partner_id_mismatch", "Mission: acknowledgement from another client"),
    _define("mavlink_mission_partner_id_mismatch2", "Mission: request from another client"),
    _define("mavlink_mission_mis_req_ignored_busy", "Mission request ignored: busy"),
    _define("mavlink_mission_wp_unexpected", "Mission transfer ended: unexpected item"),
    _define("mavlink_mission_ignore_mis_count", "Mission upload ignored: busy"),
    _define("mavlink_mission_getlist_busy", "Mission upload ignored: another is running"),
    _define("mavlink_mission_no_transfer", "Mission item ignored: no transfer is running"),
    _define("mavlink_mission_mis_item_busy", "Mission item ignored: busy"),
    _define("mavlink_mission_mis_item_invalid", "Mission item is not valid, transfer ended"),
    _define("mavlink_mission_ignore_clear", "Mission is not cleared: busy"),
    _define("mavlink_mission_state_busy", "Mission item is not set: busy"),
    _define("mavlink_mission_seq_out_of_bounds", "The mission item does not exist"),
    _define(
        "logger_open_file_time",
        "Log {1}-{2}-{3}/{4}_{5}_{6}.ulg opened",
        "year:uint16_t month:uint8_t day:uint8_t hour:uint8_t minute:uint8_t second:uint8_t",
    ),
)

CATALOGUE: dict[str, Definition] = {
    definition.name: definition for definition in _COMMANDER + _CHECKS + _CONTROL + _NAVIGATOR + _TRANSFER
}
