"""Parameters that set or limit others, after PX4 v1.14's ``MulticopterPositionControl::parameters_update``.

SYS_VEHICLE_RESP, MPC_XY_VEL_ALL and MPC_Z_VEL_ALL are inputs that overwrite the parameters which they stand for as long
as they are not negative. Speeds and tilts beyond their own maximum parameter are lowered to it, with a text.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from xtdrone_autopilot.parameters.parameter_file import as_float32

Value = int | float
Notice = Callable[[str, str, float], None]
"""Receives a text, the name of its event and the event's argument, a value that a parameter has been set to."""

_SAFE_TILT = 89.0  # deg
_POSITION_MODES = (0, 3, 4)  # MPC_POS_MODE
_UNSMOOTHED_YAW = 0.6  # responsiveness above which MPC_MAN_Y_TAU is 0
_STEEPER = 0.5  # responsiveness above which MPC_TILTMAX_AIR rises
_TILT = (45.0, 70.0)  # deg

# parameters by SYS_VEHICLE_RESP: values at a responsiveness of 0 and 1
_RESPONSE = {
    "MPC_ACC_HOR": (1.0, 15.0),
    "MPC_ACC_HOR_MAX": (2.0, 15.0),
    "MPC_MAN_Y_MAX": (80.0, 450.0),
    "MPC_ACC_DOWN_MAX": (0.8, 15.0),
    "MPC_ACC_UP_MAX": (1.0, 15.0),
    "MPC_JERK_MAX": (2.0, 50.0),
    "MPC_JERK_AUTO": (1.0, 25.0),
}
_HORIZONTAL = ("MPC_VEL_MANUAL", "MPC_XY_CRUISE", "MPC_XY_VEL_MAX")
_OWN_SPEEDS = ("MPC_VEL_MAN_BACK", "MPC_VEL_MAN_SIDE")  # -1: MPC_VEL_MANUAL
# parameters by MPC_Z_VEL_ALL: factors on it
_VERTICAL = {
    "MPC_Z_V_AUTO_UP": 1.0,
    "MPC_Z_VEL_MAX_UP": 1.0,
    "MPC_Z_V_AUTO_DN": 0.75,
    "MPC_Z_VEL_MAX_DN": 0.75,
    "MPC_TKO_SPEED": 0.6,
    "MPC_LAND_SPEED": 0.5,
}
# parameter, its upper limit, text and event
_LIMITS = (
    ("MPC_TILTMAX_LND", "MPC_TILTMAX_AIR", "Land tilt has been constrained by max tilt", "mc_pos_ctrl_land_tilt_set"),
    ("MPC_XY_CRUISE", "MPC_XY_VEL_MAX", "Cruise speed has been constrained by max speed", "mc_pos_ctrl_cruise_set"),
    ("MPC_VEL_MANUAL", "MPC_XY_VEL_MAX", "Manual speed has been constrained by max speed", "mc_pos_ctrl_man_vel_set"),
    (
        "MPC_VEL_MAN_BACK",
        "MPC_VEL_MANUAL",
        "Manual backward speed has been constrained by forward speed",
        "mc_pos_ctrl_man_vel_back_set",
    ),
    (
        "MPC_VEL_MAN_SIDE",
        "MPC_VEL_MANUAL",
        "Manual sideways speed has been constrained by forward speed",
        "mc_pos_ctrl_man_vel_side_set",
    ),
    ("MPC_Z_V_AUTO_UP", "MPC_Z_VEL_MAX_UP", "Ascent speed has been constrained by max speed", "mc_pos_ctrl_up_vel_set"),
    (
        "MPC_Z_V_AUTO_DN",
        "MPC_Z_VEL_MAX_DN",
        "Descent speed has been constrained by max speed",
        "mc_pos_ctrl_down_vel_set",
    ),
)

# bits of EKF2_AID_MASK, in groups: the bits that each sets or clears in the parameter of today, text and event
_FORMER_BITS = (
    ("EKF2_GPS_CTRL", {1: 0, 128: 0}, "Use EKF2_GPS_CTRL instead", "ekf2_aid_mask_gps"),
    ("EKF2_OF_CTRL", {2: 1}, "Use EKF2_OF_CTRL instead", "ekf2_aid_mask_opt_flow"),
    (
        "EKF2_EV_CTRL",
        {8: 3, 16: 8, 256: 4},
        "EKF2 EV use EKF2_EV_CTRL instead of EKF2_AID_MASK",
        "ekf2_aid_mask_ev",
    ),
    (
        "EKF2_IMU_CTRL",
        {4: -3},
        "EKF2 IMU accel bias inhibit use EKF2_IMU_CTRL instead of EKF2_AID_MASK",
        "ekf2_aid_mask_imu",
    ),
)

NAMES = frozenset(
    (
        "EKF2_AID_MASK", *(row[0] for row in _FORMER_BITS),
        "SYS_VEHICLE_RESP", "MPC_XY_VEL_ALL", "MPC_Z_VEL_ALL", "MPC_MAN_Y_TAU", "MPC_TILTMAX_AIR", "MPC_POS_MODE",
        "MPC_THR_HOVER", "MPC_THR_MIN", "MPC_THR_MAX", *_RESPONSE, *_HORIZONTAL, *_OWN_SPEEDS, *_VERTICAL,
        *(name for row in _LIMITS for name in row[:2]),
    )
)  # fmt: skip
"""Parameters after whose change ``adjust`` must be called."""

# those that act on others, in the order in which they must be set so that all keep their value
_FIRST = (
    "SYS_VEHICLE_RESP", "MPC_XY_VEL_ALL", "MPC_Z_VEL_ALL", "MPC_XY_VEL_MAX", "MPC_VEL_MANUAL", "MPC_Z_VEL_MAX_UP",
    "MPC_Z_VEL_MAX_DN", "MPC_TILTMAX_AIR", "MPC_THR_MAX", "MPC_THR_MIN",
)  # fmt: skip


def in_order(names: Iterable[str]) -> list[str]:
    """Return ``names`` in an order in which they can be set one by one without one changing another's value."""
    rank = {name: i for i, name in enumerate(_FIRST)}
    return sorted(names, key=lambda name: rank.get(name, len(rank)))


def by_response(setting: float) -> dict[str, float]:
    """Return the parameters that a SYS_VEHICLE_RESP of 0..1 stands for, by name."""
    x = setting * setting  # finer at the lower end
    found = {name: low + x * (high - low) for name, (low, high) in _RESPONSE.items()}
    found["MPC_MAN_Y_TAU"] = max(0.0, 0.5 * (1.0 - x / _UNSMOOTHED_YAW))
    steeper = max(0.0, x - _STEEPER) / (1.0 - _STEEPER)
    found["MPC_TILTMAX_AIR"] = min(_SAFE_TILT, _TILT[0] + steeper * (_TILT[1] - _TILT[0]))
    return found


def _inputs(get: Callable[[str], Value]) -> dict[str, float]:
    """Return the parameters that the three inputs stand for, by name; an input below 0 stands for none."""
    found: dict[str, float] = {}
    response, horizontal, vertical = get("SYS_VEHICLE_RESP"), get("MPC_XY_VEL_ALL"), get("MPC_Z_VEL_ALL")
    if response >= 0.0:
        found |= by_response(response)
    if horizontal >= 0.0:
        found |= dict.fromkeys(_HORIZONTAL, horizontal) | dict.fromkeys(_OWN_SPEEDS, -1.0)
    if vertical >= 0.0:
        found |= {name: factor * vertical for name, factor in _VERTICAL.items()}
    return found


def _follow_former_bits(get: Callable[[str], Value], store: Callable[[str, float], object], notice: Notice) -> None:
    """Move the bits of EKF2_AID_MASK to the parameters that replace it, after PX4's ``EKF2::VerifyParams``.

    A row's number is or-ed into the parameter; a negative one is and-ed.
    """
    for name, bits, text, event in _FORMER_BITS:
        given = [bit for bit in bits if int(get("EKF2_AID_MASK")) & bit]
        if not given:
            continue
        for bit in given:
            value, change = int(get(name)), bits[bit]
            store(name, value | change if change >= 0 else value & change)
        store("EKF2_AID_MASK", int(get("EKF2_AID_MASK")) & ~sum(given))
        notice(text, event, float(get("EKF2_AID_MASK")))


def adjust(get: Callable[[str], Value], store: Callable[[str, float], object], notice: Notice) -> None:
    """Set the parameters that the three inputs stand for, and lower those beyond their maximum.

    Args:
        get: returns the value of a parameter.
        store: stores a value of a parameter.
        notice: is told of each limit that has acted.
    """
    for name, value in _inputs(get).items():
        store(name, as_float32(value))
    _follow_former_bits(get, store, notice)
    if int(get("MPC_POS_MODE")) not in _POSITION_MODES:
        store("MPC_POS_MODE", _POSITION_MODES[-1])
    if get("MPC_TILTMAX_AIR") > _SAFE_TILT:
        store("MPC_TILTMAX_AIR", _SAFE_TILT)
        notice("Tilt constrained to safe value", "mc_pos_ctrl_tilt_set", _SAFE_TILT)
    for name, limit, text, event in _LIMITS:
        largest = get(limit)
        if get(name) > largest:
            store(name, largest)
            notice(text, event, largest)
    hover = min(max(get("MPC_THR_HOVER"), get("MPC_THR_MIN")), get("MPC_THR_MAX"))
    if hover != get("MPC_THR_HOVER"):
        store("MPC_THR_HOVER", hover)
        notice("Hover thrust has been constrained by min/max", "mc_pos_ctrl_hover_thrust_set", hover)
