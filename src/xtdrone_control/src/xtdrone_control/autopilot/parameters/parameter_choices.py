"""What the values of parameters mean that are choices, and what the bits of those are that are sets.

A ground station offers these words in place of the numbers.
"""

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
    "CA_FAILURE_MODE": {0: "a failed motor is not known of", 1: "a failed motor is left out"},
    "CBRK_FLIGHTTERM": {0: "the attitude limit terminates the flight", 121_212: "it warns"},
    "CBRK_SUPPLY_CHK": {0: "the battery is looked at", 894_281: "it is not"},
    "COM_ACT_FAIL_ACT": {0: "warning", 1: "hold", 2: "land", 3: "return", 4: "terminate"},
    "COM_ARM_MIS_REQ": _NO_YES,
    "COM_ARM_SWISBTN": {0: "switch", 1: "button"},
    "COM_ARM_WO_GPS": {0: "a GPS fix is required", 1: "warning only"},
    **{f"COM_FLTMODE{number}": _SLOT for number in range(1, 7)},
    "COM_HOME_EN": _OFF_ON,
    "COM_LOW_BAT_ACT": {0: "warning", 1: "return", 2: "land", 3: "return when critical, land when almost empty"},
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
    "COM_POSCTL_NAVL": {0: "go on by altitude or by hand", 1: "land or descend"},
    "COM_RC_IN_MODE": {0: "radio", 1: "joystick", 2: "either", 3: "the one that comes first", 4: "none"},
    "EKF2_BARO_CTRL": _OFF_ON,
    "EKF2_EV_NOISE_MD": {0: "the message's, at least the parameters'", 1: "the parameters'"},
    "EKF2_HGT_REF": {0: "barometer", 1: "GPS", 2: "range finder", 3: "vision"},
    "EKF2_MAG_TYPE": {0: "heading", 1: "heading", 5: "none", 6: "heading at start only"},
    "EKF2_OF_CTRL": _OFF_ON,
    "EKF2_RNG_CTRL": {0: "never", 1: "when low and slow", 2: "always"},
    "FD_ACT_EN": _OFF_ON,
    "FLW_TGT_ALT_M": {0: "home", 1: "the ground below", 2: "the target"},
    "GF_ACTION": {0: "none", 1: "warning", 2: "hold", 3: "return", 4: "terminate", 5: "land"},
    "GF_PREDICT": _OFF_ON,
    "GF_SOURCE": {0: "estimate", 1: "GPS"},
    "MAN_ARM_GESTURE": _OFF_ON,
    "MAV_PROTO_VER": {0: "begin with version 1", 1: "always version 1", 2: "begin with version 2"},
    "MIS_TKO_LAND_REQ": {
        0: "nothing",
        1: "a takeoff",
        2: "a landing",
        3: "a takeoff and a landing",
        4: "both or neither",
    },
    "MC_AIRMODE": {0: "off", 1: "roll and pitch", 2: "roll, pitch and yaw"},
    "MPC_POS_MODE": {0: "velocity", 3: "smoothed velocity", 4: "acceleration"},
    "MPC_THR_CURVE": {0: "the middle hovers", 1: "straight"},
    "MPC_USE_HTE": _OFF_ON,
    "MPC_YAW_MODE": {
        0: "towards the waypoint",
        1: "towards home",
        2: "away from home",
        3: "along the way",
        4: "towards the waypoint, before flying there",
    },
    "NAV_DLL_ACT": {0: "none", **_LINK_LOST},
    "NAV_RCL_ACT": _LINK_LOST,
    **{
        f"RC_MAP_{what}": _CHANNEL
        for what in (
            "ARM_SW", "FLTMODE", "KILL_SW", "LOITER_SW", "OFFB_SW", "PITCH", "RETURN_SW", "ROLL", "THROTTLE", "YAW",
        )
    },
    **{f"RC{number}_REV": {-1: "reversed", 1: "normal"} for number in range(1, 19)},
    "RTL_PLD_MD": {0: "no precision landing", 1: "if a target is seen", 2: "search for the target"},
    "RTL_TYPE": {
        0: "home or a rally point",
        1: "where the mission lands, or a rally point",
        2: "where the mission lands",
        3: "the closest of home, rally points and where the mission lands",
    },
    "SDLOG_MODE": {
        -1: "never",
        0: "while armed",
        1: "from boot until disarming",
        2: "from boot on",
        4: "from the first arming on",
    },
    "SYS_FAILURE_EN": _OFF_ON,
}  # fmt: skip

# by number of the bit
BITS: dict[str, dict[int, str]] = {
    "COM_RCL_EXCEPT": {0: "mission", 1: "hold", 2: "offboard"},
    "COM_RC_OVERRIDE": {0: "AUTO modes", 1: "OFFBOARD"},
    "EKF2_EV_CTRL": {0: "horizontal position", 1: "height", 2: "velocity", 3: "yaw"},
    "EKF2_GPS_CHECK": {0: "satellites", 1: "dilution of precision", 2: "horizontal error", 3: "vertical error",
                       4: "speed error"},
    "EKF2_GPS_CTRL": {0: "horizontal position", 1: "altitude", 2: "velocity"},
    "EKF2_MAG_CHECK": {0: "strength of the field"},
}  # fmt: skip

# what is looked at only when the autopilot starts
AT_START = frozenset({"EKF2_ABIAS_INIT", "EKF2_ANGERR_INIT", "EKF2_GBIAS_INIT"})
# what the fleet gives, whatever the parameter says
FIXED = frozenset({"MAV_COMP_ID", "MAV_SYS_ID"})
