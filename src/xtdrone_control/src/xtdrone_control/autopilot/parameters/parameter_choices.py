"""Labels of parameter values and of parameter bits, which ground stations show instead of the numbers."""

from __future__ import annotations

_OFF_ON = {0: "off", 1: "on"}
_NO_YES = {0: "no", 1: "yes"}
_LINK_LOST = {1: "hold", 2: "return", 3: "land", 5: "terminate", 6: "disarm"}
_SLOT = {
    -1: "unassigned",
    0: "manual",
    1: "altitude",
    2: "position",
    3: "mission",
    4: "hold",
    5: "return",
    6: "acro",
    7: "offboard",
    8: "stabilized",
    10: "takeoff",
    11: "land",
    12: "follow me",
    13: "precision landing",
}
_CHANNEL = {0: "none", **{number: f"channel {number}" for number in range(1, 19)}}

CHOICES: dict[str, dict[int, str]] = {
    "BAT1_N_CELLS": {number: f"{number}S" for number in range(1, 17)},
    "CA_METHOD": {0: "clip", 1: "give up thrust and yaw", 2: "give up thrust and yaw"},
    "CA_FAILURE_MODE": {0: "failed motors are ignored", 1: "failed motors are removed from the mixer"},
    "BAT1_SOURCE": {-1: "none", 0: "the simulated battery", 1: "none", 2: "none"},
    "CBRK_FLIGHTTERM": {0: "terminate beyond the attitude limits", 121_212: "warn only"},
    "CBRK_SUPPLY_CHK": {0: "check the battery", 894_281: "skip the battery check"},
    "COM_ACT_FAIL_ACT": {0: "warning", 1: "hold", 2: "land", 3: "return", 4: "terminate"},
    "COM_ARM_MIS_REQ": _NO_YES,
    "COM_ARM_SWISBTN": {0: "switch", 1: "button"},
    "COM_ARM_WO_GPS": {0: "a GPS fix is required", 1: "warning only"},
    **{f"COM_FLTMODE{number}": _SLOT for number in range(1, 7)},
    "COM_HOME_EN": _OFF_ON,
    "COM_HOME_IN_AIR": _OFF_ON,
    "COM_LOW_BAT_ACT": {0: "warning", 1: "return", 2: "land", 3: "return when critical, land when almost empty"},
    "COM_MOT_TEST_EN": _OFF_ON,
    "COM_OBL_RC_ACT": {
        0: "position",
        1: "altitude",
        2: "stabilized",
        3: "return",
        4: "land",
        5: "hold",
        6: "terminate",
        7: "disarm",
    },
    "COM_POSCTL_NAVL": {0: "altitude or manual control", 1: "land or descend"},
    "COM_RC_IN_MODE": {0: "radio", 1: "joystick", 2: "either", 3: "the first to arrive", 4: "none"},
    "COM_TAKEOFF_ACT": {0: "hold", 1: "mission"},
    "CP_GO_NO_DATA": _NO_YES,
    "EKF2_BARO_CTRL": _OFF_ON,
    "EKF2_EV_NOISE_MD": {0: "the larger of message and parameters", 1: "parameters only"},
    "EKF2_HGT_REF": {0: "barometer", 1: "GPS", 2: "range finder", 3: "vision"},
    "EKF2_MAG_TYPE": {0: "heading", 1: "heading", 5: "none", 6: "initial heading only"},
    "EKF2_OF_CTRL": _OFF_ON,
    "EKF2_RNG_CTRL": {0: "never", 1: "when low and slow", 2: "always"},
    "FD_ACT_EN": _OFF_ON,
    "FLW_TGT_ALT_M": {0: "home", 1: "the ground below", 2: "the target"},
    "GF_ACTION": {0: "none", 1: "warning", 2: "hold", 3: "return", 4: "terminate", 5: "land"},
    "GF_PREDICT": _OFF_ON,
    "GF_SOURCE": {0: "estimate", 1: "GPS"},
    "MAN_ARM_GESTURE": _OFF_ON,
    "MAV_PROTO_VER": {0: "start with version 1", 1: "always version 1", 2: "start with version 2"},
    "MIS_TKO_LAND_REQ": {
        0: "nothing",
        1: "a takeoff",
        2: "a landing",
        3: "a takeoff and a landing",
        4: "both or neither",
    },
    "MC_AIRMODE": {0: "off", 1: "roll and pitch", 2: "roll, pitch and yaw"},
    "MPC_ALT_MODE": {0: "altitude", 1: "above ground", 2: "above ground at standstill"},
    "MPC_POS_MODE": {0: "velocity", 3: "smoothed velocity", 4: "acceleration"},
    "MPC_THR_CURVE": {0: "hover at the middle", 1: "linear"},
    "MPC_USE_HTE": _OFF_ON,
    "MPC_YAW_MODE": {
        0: "towards the waypoint",
        1: "towards home",
        2: "away from home",
        3: "along the path",
        4: "towards the waypoint, before flying there",
    },
    "NAV_DLL_ACT": {0: "none", **_LINK_LOST},
    "NAV_RCL_ACT": _LINK_LOST,
    **{
        f"RC_MAP_{function}": _CHANNEL
        for function in (
            "ARM_SW", "FLTMODE", "KILL_SW", "LOITER_SW", "OFFB_SW", "PITCH", "RETURN_SW", "ROLL", "THROTTLE", "YAW",
        )
    },
    **{f"RC{number}_REV": {-1: "reversed", 1: "normal"} for number in range(1, 19)},
    "LTEST_MODE": {0: "moving", 1: "stationary"},
    "RTL_HDG_MD": {0: "along the path", 1: "that of home", 2: "the current one"},
    "RTL_PLD_MD": {0: "no precision landing", 1: "if a target is visible", 2: "search for the target"},
    "RTL_TYPE": {
        0: "home or a rally point",
        1: "mission landing or a rally point",
        2: "mission landing",
        3: "the closest of home, rally points and mission landing",
    },
    "SDLOG_MODE": {
        -1: "never",
        0: "while armed",
        1: "from boot until disarming",
        2: "from boot until shutdown",
        4: "from the first arming until shutdown",
    },
    "SYS_FAILURE_EN": _OFF_ON,
    **{f"SYS_HAS_{sensor}": _NO_YES for sensor in ("BARO", "GPS", "MAG")},
}  # fmt: skip

# labels by bit number
BITS: dict[str, dict[int, str]] = {
    "COM_RCL_EXCEPT": {0: "mission", 1: "hold", 2: "offboard"},
    "COM_RC_OVERRIDE": {0: "AUTO modes", 1: "OFFBOARD"},
    "EKF2_EV_CTRL": {0: "horizontal position", 1: "height", 2: "velocity", 3: "yaw"},
    "EKF2_GPS_CHECK": {0: "satellites", 1: "dilution of precision", 2: "horizontal error", 3: "vertical error",
                       4: "speed error"},
    "EKF2_GPS_CTRL": {0: "horizontal position", 1: "altitude", 2: "velocity"},
    "EKF2_IMU_CTRL": {0: "gyroscope bias", 1: "accelerometer bias"},
    "EKF2_MAG_CHECK": {0: "strength of the field"},
}  # fmt: skip

# parameters that take effect only at start
AT_START = frozenset({"EKF2_ABIAS_INIT", "EKF2_ANGERR_INIT", "EKF2_GBIAS_INIT"})
# parameters that change by themselves, which the hash of all parameters leaves out
VOLATILE = frozenset({"COM_FLIGHT_UUID", "LND_FLIGHT_T_HI", "LND_FLIGHT_T_LO"})
# parameters set by the fleet, which cannot be changed
FIXED = frozenset({"MAV_COMP_ID", "MAV_SYS_ID"})
