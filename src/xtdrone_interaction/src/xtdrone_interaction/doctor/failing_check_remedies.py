"""Remedies for each failing check of the autopilot, by the name of its event."""

from __future__ import annotations

_ESTIMATOR = "wait a few seconds of simulated time on the ground; an injected sensor failure does not go away"
_POSITION = (
    "after the start this takes a few seconds of simulated time; if it persists, check GPS (an injected failure, "
    "EKF2_GPS_CTRL, SYS_HAS_GPS); without GPS it needs vision or optical flow"
)
_BATTERY = "charge it: ./xtdrone sim reset; BAT1_* has the limits"

CHECKS = {
    "check_modes_cannot_takeoff": "switch to another mode before arming: AUTO.LOITER, AUTO.TAKEOFF or OFFBOARD",
    "check_modes_attitude": "wait until the estimator has started",
    "check_modes_local_pos": _POSITION,
    "check_modes_global_pos": "wait for GPS; without it publish mavros/global_position/set_gp_origin, launch with "
    "datum_known:=true, or fly in OFFBOARD, POSCTL, AUTO.TAKEOFF and AUTO.LAND",
    "check_modes_local_alt": "wait until the estimator has started; later: check EKF2_HGT_REF and the barometer",
    "check_modes_mission": "upload a mission (QGroundControl, ./xtdrone gcs upload), or set COM_ARM_MIS_REQ to 0",
    "check_modes_offboard_signal": "publish setpoints at 2 Hz or faster before switching to OFFBOARD",
    "check_modes_home_position": "wait for GPS, which sets it, or call cmd/set_home",
    "check_modes_manual_control": "connect a joystick or radio, or switch to a mode without: AUTO.LOITER, OFFBOARD",
    "check_battery_unhealthy": _BATTERY,
    "check_battery_critical": _BATTERY,
    "check_battery_emergency": _BATTERY,
    "check_rc_dl_no_dllink": "connect a ground station (QGroundControl, ./xtdrone gcs status), or set NAV_DLL_ACT to 0",
    "check_failure_detector_attitude": "the vehicle is tipped over: ./xtdrone sim reset (limits: FD_FAIL_R, FD_FAIL_P)",
    "check_failure_detector_motor": "a motor has failed: end the injected failure, or ./xtdrone sim reset",
    "check_gf_violation": "it is outside its geofence: clear or move the fence (geofence/clear)",
    "check_estimator_vel_not_stable": f"{_ESTIMATOR}; COM_ARM_EKF_VEL is the limit",
    "check_estimator_pos_not_stable": f"{_ESTIMATOR}; COM_ARM_EKF_POS is the limit",
    "check_estimator_hgt_not_stable": f"{_ESTIMATOR}; COM_ARM_EKF_HGT is the limit",
    "check_estimator_heading_not_stable": f"{_ESTIMATOR}; COM_ARM_EKF_YAW is the limit",
    "check_estimator_gps_fix_too_low": "GPS has no fix: end an injected failure, or set COM_ARM_WO_GPS to 1 to "
    "fly without it",
}
UNKNOWN_CHECK = "a ground station shows the details; with PX4, its documentation of the check"
