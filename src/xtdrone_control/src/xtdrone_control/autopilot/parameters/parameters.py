"""The autopilot's parameters: names, types and defaults of PX4 v1.14.

Defaults are those of a PX4 v1.14.3 SITL build; a vehicle's description overrides them for its airframe. Kernels read
the ``PARAMS`` record, which has one float64 field per kernel parameter, with its name in lower case. All other code
reads ``Parameters``. ``inert_parameters`` lists the parameters that are stored without effect.
"""

from __future__ import annotations

import logging
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from struct import pack
from typing import Any

import numpy as np

from xtdrone_control import parameter_file
from xtdrone_control.autopilot.parameters import inert_parameters

INT32 = 6  # MAV_PARAM_TYPE_INT32
FLOAT = 9  # MAV_PARAM_TYPE_REAL32

_log = logging.getLogger(__name__)
_INT32_RANGE = (-(1 << 31), (1 << 31) - 1)
_FLOAT_MAX = 3.4028234663852886e38
_CRC_FLIP = 0xFFFFFFFF
_FIXED = ("MAV_SYS_ID", "MAV_COMP_ID")  # set by the fleet, never from a file


class ParameterError(ValueError):
    """A parameter that does not exist, or a value that its type cannot hold."""


@dataclass(frozen=True)
class Parameter:
    """Definition of a parameter.

    Attributes:
        name: PX4's name.
        type: ``INT32`` or ``FLOAT``, the numbers of MAV_PARAM_TYPE.
        default: PX4's default.
        minimum: least sensible value; a smaller one is stored with a warning, as in PX4.
        maximum: largest sensible value, likewise.
        unit: unit, empty for none.
        text: short description.
        has_effect: whether the parameter is read, not only stored.
    """

    name: str
    type: int
    default: float
    minimum: float
    maximum: float
    unit: str
    text: str
    has_effect: bool = True


_INF = math.inf

# name, default, minimum, maximum, unit, text; an int as default makes the parameter an INT32
_KERNEL_ROWS: tuple[tuple[str, float, float, float, str, str], ...] = (
    ("EKF2_GYR_NOISE", 0.015, 0.0001, 0.1, "rad/s", "gyroscope noise in the prediction"),
    ("EKF2_ACC_NOISE", 0.35, 0.01, 1.0, "m/s^2", "accelerometer noise in the prediction"),
    ("EKF2_GYR_B_NOISE", 0.001, 0.0, 0.01, "rad/s^2", "process noise of the gyroscope bias"),
    ("EKF2_ACC_B_NOISE", 0.003, 0.0, 0.01, "m/s^3", "process noise of the accelerometer bias"),
    ("EKF2_GPS_P_NOISE", 0.5, 0.01, 10.0, "m", "least noise of GPS position"),
    ("EKF2_GPS_V_NOISE", 0.3, 0.01, 5.0, "m/s", "least noise of GPS velocity"),
    ("EKF2_GPS_P_GATE", 5.0, 1.0, _INF, "SD", "innovation gate of GPS position"),
    ("EKF2_GPS_V_GATE", 5.0, 1.0, _INF, "SD", "innovation gate of GPS velocity"),
    ("EKF2_BARO_NOISE", 3.5, 0.01, 15.0, "m", "noise of the pressure altitude"),
    ("EKF2_BARO_GATE", 5.0, 1.0, _INF, "SD", "innovation gate of the pressure altitude"),
    ("EKF2_HEAD_NOISE", 0.3, 0.01, 1.0, "rad", "noise of the magnetic heading without the bias"),
    ("EKF2_HDG_GATE", 2.6, 1.0, _INF, "SD", "innovation gate of the magnetic heading"),
    ("EKF2_MAG_DECL", 0.0, -180.0, 180.0, "deg", "magnetic declination, positive east"),
    ("EKF2_GBIAS_INIT", 0.1, 0.0, 0.2, "rad/s", "initial uncertainty of the gyroscope bias"),
    ("EKF2_ABIAS_INIT", 0.2, 0.0, 0.5, "m/s^2", "initial uncertainty of the accelerometer bias"),
    ("EKF2_ABL_LIM", 0.4, 0.0, 0.8, "m/s^2", "limit of the estimated accelerometer bias"),
    ("EKF2_REQ_EPH", 3.0, 2.0, 100.0, "m", "largest horizontal GPS error for GPS use"),
    ("EKF2_REQ_EPV", 5.0, 2.0, 100.0, "m", "largest vertical GPS error for GPS use"),
    ("EKF2_REQ_SACC", 0.5, 0.5, 5.0, "m/s", "largest GPS speed error for GPS use"),
    ("EKF2_REQ_NSATS", 6, 4, 12, "", "least number of satellites for GPS use"),
    ("EKF2_REQ_PDOP", 2.5, 1.5, 5.0, "", "largest dilution of precision for GPS use"),
    ("EKF2_REQ_GPS_H", 0.5, 0.1, _INF, "s", "time for which the GPS checks must pass before GPS use"),
    ("EKF2_GPS_CHECK", 245, 0, 511, "", "bits of GPS checks: 1 satellites, 2 PDOP, 4 EPH, 8 EPV, 16 speed error"),
    ("EKF2_GPS_CTRL", 7, 0, 15, "", "bits of GPS use: 1 position, 2 altitude, 4 velocity"),
    ("EKF2_BARO_CTRL", 1, 0, 1, "", "1: use the barometer"),
    ("EKF2_HGT_REF", 1, 0, 3, "", "height reference: 0 barometer, 1 GPS, 2 range finder, 3 vision"),
    ("EKF2_MAG_TYPE", 0, 0, 6, "", "0 to 4: use the magnetic heading; 5: never; 6: only for the initial heading"),
    ("EKF2_MAG_CHECK", 1, 0, 7, "", "1: require the Earth's magnetic field strength"),
    ("EKF2_MAG_NOISE", 0.05, 0.001, 1.0, "gauss", "initial uncertainty of the magnetometer bias"),
    ("EKF2_MAG_B_NOISE", 0.0001, 0.0, 0.1, "gauss/s", "process noise of the magnetometer bias"),
    (
        "EKF2_ANGERR_INIT",
        0.1,
        0.0,
        0.5,
        "rad",
        "initial uncertainty of the tilt, in addition to that from the accelerometer bias",
    ),
    ("EKF2_GYR_B_LIM", 0.15, 0.0, 0.4, "rad/s", "limit of the estimated gyroscope bias"),
    ("EKF2_EV_CTRL", 15, 0, 15, "", "bits of vision use: 1 horizontal position, 2 height, 4 velocity, 8 yaw"),
    ("EKF2_EV_NOISE_MD", 0, 0, 1, "", "vision noise: 0 the larger of message and parameters, 1 parameters only"),
    ("EKF2_EV_QMIN", 0, 0, 100, "", "least quality of vision samples"),
    ("EKF2_EVA_NOISE", 0.1, 0.05, _INF, "rad", "least noise of vision yaw"),
    ("EKF2_EVP_NOISE", 0.1, 0.01, _INF, "m", "least noise of vision position"),
    ("EKF2_EVV_NOISE", 0.1, 0.01, _INF, "m/s", "least noise of vision velocity"),
    ("EKF2_EVP_GATE", 5.0, 1.0, _INF, "SD", "innovation gate of vision position"),
    ("EKF2_EVV_GATE", 3.0, 1.0, _INF, "SD", "innovation gate of vision velocity"),
    ("EKF2_OF_CTRL", 0, 0, 1, "", "1: use optical flow"),
    ("EKF2_OF_N_MIN", 0.15, 0.05, _INF, "rad/s", "noise of optical flow at the best quality"),
    ("EKF2_OF_N_MAX", 0.5, 0.05, _INF, "rad/s", "noise of optical flow at quality EKF2_OF_QMIN"),
    ("EKF2_OF_QMIN", 1, 0, 255, "", "least quality of optical flow samples"),
    ("EKF2_OF_GATE", 3.0, 1.0, _INF, "SD", "innovation gate of optical flow"),
    ("EKF2_RNG_CTRL", 1, 0, 2, "", "use of the range finder for height: 0 never, 1 when low and slow, 2 always"),
    ("EKF2_RNG_A_HMAX", 5.0, 1.0, 10.0, "m", "largest height above ground for EKF2_RNG_CTRL 1"),
    ("EKF2_RNG_A_VMAX", 1.0, 0.1, 2.0, "m/s", "largest speed for EKF2_RNG_CTRL 1"),
    ("EKF2_RNG_NOISE", 0.1, 0.01, _INF, "m", "noise of the range finder"),
    ("EKF2_RNG_SFE", 0.05, 0.0, 0.2, "m/m", "range finder noise proportional to range"),
    ("EKF2_RNG_GATE", 5.0, 1.0, _INF, "SD", "innovation gate of the range finder"),
    ("EKF2_MIN_RNG", 0.1, 0.01, _INF, "m", "range finder distance on the ground"),
    ("EKF2_TERR_NOISE", 5.0, 0.5, _INF, "m/s", "process noise of the terrain height"),
    ("EKF2_NOAID_NOISE", 10.0, 0.5, 50.0, "m", "noise of the position held without aiding"),
    (
        "EKF2_NOAID_TOUT",
        5_000_000,
        500_000,
        10_000_000,
        "us",
        "time without aiding after which the position is invalid",
    ),
    ("MPC_XY_P", 0.95, 0.0, 2.0, "1/s", "horizontal velocity per position error"),
    ("MPC_XY_VEL_P_ACC", 1.8, 1.2, 5.0, "1/s", "acceleration per horizontal velocity error"),
    ("MPC_XY_VEL_I_ACC", 0.4, 0.0, 60.0, "1/s^2", "acceleration per integrated horizontal velocity error"),
    ("MPC_XY_VEL_D_ACC", 0.2, 0.1, 2.0, "", "acceleration per horizontal acceleration"),
    ("MPC_Z_P", 1.0, 0.0, 1.5, "1/s", "vertical velocity per position error"),
    ("MPC_Z_VEL_P_ACC", 4.0, 2.0, 15.0, "1/s", "acceleration per vertical velocity error"),
    ("MPC_Z_VEL_I_ACC", 2.0, 0.2, 3.0, "1/s^2", "acceleration per integrated vertical velocity error"),
    ("MPC_Z_VEL_D_ACC", 0.0, 0.0, 2.0, "", "acceleration per vertical acceleration"),
    ("MPC_XY_VEL_MAX", 12.0, 0.0, 20.0, "m/s", "largest horizontal velocity"),
    ("MPC_XY_CRUISE", 5.0, 3.0, 20.0, "m/s", "horizontal velocity in AUTO modes"),
    ("MPC_Z_VEL_MAX_UP", 3.0, 0.5, 8.0, "m/s", "largest climb rate"),
    ("MPC_Z_VEL_MAX_DN", 1.5, 0.5, 4.0, "m/s", "largest sink rate"),
    ("MPC_Z_V_AUTO_UP", 3.0, 0.5, 8.0, "m/s", "climb rate in AUTO modes"),
    ("MPC_Z_V_AUTO_DN", 1.5, 0.5, 4.0, "m/s", "sink rate in AUTO modes"),
    ("MPC_VEL_MANUAL", 10.0, 3.0, 20.0, "m/s", "horizontal velocity at full stick"),
    ("MPC_ACC_HOR", 3.0, 2.0, 15.0, "m/s^2", "horizontal acceleration in AUTO modes"),
    ("MPC_ACC_UP_MAX", 4.0, 2.0, 15.0, "m/s^2", "largest upward acceleration"),
    ("MPC_ACC_DOWN_MAX", 3.0, 2.0, 15.0, "m/s^2", "largest downward acceleration"),
    ("MPC_JERK_AUTO", 4.0, 1.0, 80.0, "m/s^3", "jerk in AUTO modes"),
    ("MPC_JERK_MAX", 8.0, 0.5, 500.0, "m/s^3", "largest jerk in stick modes"),
    ("MPC_TILTMAX_AIR", 45.0, 20.0, 89.0, "deg", "largest tilt in flight"),
    ("MPC_TILTMAX_LND", 12.0, 5.0, 89.0, "deg", "largest tilt at takeoff and touch-down"),
    ("MPC_THR_HOVER", 0.5, 0.1, 0.8, "", "thrust at which the vehicle hovers"),
    ("MPC_THR_MIN", 0.12, 0.05, 1.0, "", "least collective thrust in flight"),
    ("MPC_THR_MAX", 1.0, 0.0, 1.0, "", "largest collective thrust"),
    ("MPC_THR_XY_MARG", 0.3, 0.0, 0.5, "", "share of thrust kept for the horizontal when the vertical saturates"),
    ("MPC_TKO_SPEED", 1.5, 1.0, 5.0, "m/s", "climb rate at takeoff"),
    ("MPC_TKO_RAMP_T", 3.0, 0.0, 5.0, "s", "duration of the takeoff ramp"),
    ("MPC_LAND_SPEED", 0.7, 0.6, _INF, "m/s", "sink rate near the ground"),
    ("MPC_LAND_ALT1", 10.0, 0.0, 122.0, "m", "height below which a landing slows down"),
    ("MPC_LAND_ALT2", 5.0, 0.0, 122.0, "m", "height below which a landing descends at MPC_LAND_SPEED"),
    ("NAV_ACC_RAD", 2.0, 0.05, 200.0, "m", "horizontal acceptance radius of a waypoint"),
    ("NAV_MC_ALT_RAD", 0.8, 0.05, 200.0, "m", "vertical acceptance radius of a waypoint"),
    ("MPC_XY_TRAJ_P", 0.5, 0.1, 1.0, "", "share of the acceleration used in a turn at a waypoint"),
    (
        "MPC_LAND_CRWL",
        0.3,
        0.1,
        _INF,
        "m/s",
        "sink rate close to the ground, of which the land detector expects a share",
    ),
    ("MPC_MAN_TILT_MAX", 35.0, 1.0, 70.0, "deg", "tilt at full stick"),
    ("MC_MAN_TILT_TAU", 0.0, 0.0, 2.0, "s", "time constant of the tilt by stick"),
    ("MPC_MAN_Y_TAU", 0.08, 0.0, 5.0, "s", "time constant of the yaw rate by stick"),
    ("MPC_MANTHR_MIN", 0.08, 0.0, 1.0, "", "least thrust in flight by stick"),
    ("MPC_THR_CURVE", 0, 0, 1, "", "thrust by stick: 0 hover at the middle, 1 linear from least to largest"),
    ("MPC_POS_MODE", 4, 0, 4, "", "POSCTL sticks: 4 accelerations, other values velocities"),
    ("MC_ACRO_R_MAX", 720.0, 0.0, 1800.0, "deg/s", "roll rate at full stick in ACRO"),
    ("MC_ACRO_P_MAX", 720.0, 0.0, 1800.0, "deg/s", "pitch rate at full stick in ACRO"),
    ("MC_ACRO_Y_MAX", 540.0, 0.0, 1800.0, "deg/s", "yaw rate at full stick in ACRO"),
    ("MC_ACRO_EXPO", 0.69, 0.0, 1.0, "", "curve of roll and pitch sticks in ACRO: 0 linear, 1 cubic"),
    ("MC_ACRO_EXPO_Y", 0.69, 0.0, 1.0, "", "curve of the yaw stick in ACRO"),
    ("MC_ACRO_SUPEXPO", 0.7, 0.0, 0.95, "", "slope increase towards the ends of roll and pitch sticks in ACRO"),
    ("MC_ACRO_SUPEXPOY", 0.7, 0.0, 0.95, "", "slope increase towards the ends of the yaw stick in ACRO"),
    ("MC_AIRMODE", 0, 0, 2, "", "axes for which thrust may rise: 0 none, 1 roll and pitch, 2 roll, pitch and yaw"),
    ("HTE_HT_ERR_INIT", 0.1, 0.0, 1.0, "", "initial uncertainty of the hover thrust"),
    ("HTE_HT_NOISE", 0.0036, 0.0001, 1.0, "1/s", "process noise of the hover thrust"),
    ("HTE_ACC_GATE", 3.0, 1.0, 10.0, "SD", "innovation gate of the vertical acceleration"),
    ("HTE_THR_RANGE", 0.2, 0.01, 0.4, "", "largest difference of the hover thrust from MPC_THR_HOVER"),
    ("HTE_VXY_THR", 10.0, 1.0, 20.0, "m/s", "horizontal speed above which the noise is raised"),
    ("HTE_VZ_THR", 2.0, 1.0, 10.0, "m/s", "vertical speed above which the noise is raised"),
    ("MPC_MAN_Y_MAX", 150.0, 0.0, 400.0, "deg/s", "yaw rate at full stick"),
    ("MPC_YAWRAUTO_MAX", 45.0, 0.0, 360.0, "deg/s", "yaw rate in AUTO modes"),
    ("MPC_HOLD_DZ", 0.1, 0.0, 1.0, "", "dead zone of the sticks"),
    ("MPC_HOLD_MAX_XY", 0.8, 0.0, 3.0, "m/s", "horizontal velocity below which a centred stick holds position"),
    ("MPC_HOLD_MAX_Z", 0.6, 0.0, 3.0, "m/s", "vertical velocity below which a centred stick holds altitude"),
    ("MPC_USE_HTE", 1, 0, 1, "", "1: estimate the hover thrust in flight"),
    ("MPC_XY_ERR_MAX", 2.0, 0.1, 10.0, "m", "lag behind the smoothed path at which the path stops"),
    ("MPC_VELD_LP", 5.0, 0.0, 10.0, "Hz", "low-pass of the velocity derivative"),
    ("MC_ROLL_P", 6.5, 0.0, 12.0, "1/s", "roll rate per roll error"),
    ("MC_PITCH_P", 6.5, 0.0, 12.0, "1/s", "pitch rate per pitch error"),
    ("MC_YAW_P", 2.8, 0.0, 5.0, "1/s", "yaw rate per yaw error"),
    ("MC_YAW_WEIGHT", 0.4, 0.0, 1.0, "", "weight of yaw relative to roll and pitch"),
    ("MC_ROLLRATE_P", 0.15, 0.01, 0.5, "", "roll torque per rate error"),
    ("MC_ROLLRATE_I", 0.2, 0.0, _INF, "1/s", "roll torque per integrated rate error"),
    ("MC_ROLLRATE_D", 0.003, 0.0, 0.01, "s", "roll torque per angular acceleration"),
    ("MC_ROLLRATE_FF", 0.0, 0.0, _INF, "", "roll torque per rate setpoint"),
    ("MC_ROLLRATE_K", 1.0, 0.01, 5.0, "", "gain of the whole roll rate controller"),
    ("MC_ROLLRATE_MAX", 220.0, 0.0, 1800.0, "deg/s", "largest roll rate"),
    ("MC_PITCHRATE_P", 0.15, 0.01, 0.6, "", "pitch torque per rate error"),
    ("MC_PITCHRATE_I", 0.2, 0.0, _INF, "1/s", "pitch torque per integrated rate error"),
    ("MC_PITCHRATE_D", 0.003, 0.0, _INF, "s", "pitch torque per angular acceleration"),
    ("MC_PITCHRATE_FF", 0.0, 0.0, _INF, "", "pitch torque per rate setpoint"),
    ("MC_PITCHRATE_K", 1.0, 0.01, 5.0, "", "gain of the whole pitch rate controller"),
    ("MC_PITCHRATE_MAX", 220.0, 0.0, 1800.0, "deg/s", "largest pitch rate"),
    ("MC_YAWRATE_P", 0.2, 0.0, 0.6, "", "yaw torque per rate error"),
    ("MC_YAWRATE_I", 0.1, 0.0, _INF, "1/s", "yaw torque per integrated rate error"),
    ("MC_YAWRATE_D", 0.0, 0.0, _INF, "s", "yaw torque per angular acceleration"),
    ("MC_YAWRATE_FF", 0.0, 0.0, _INF, "", "yaw torque per rate setpoint"),
    ("MC_YAWRATE_K", 1.0, 0.0, 5.0, "", "gain of the whole yaw rate controller"),
    ("MC_YAWRATE_MAX", 200.0, 0.0, 1800.0, "deg/s", "largest yaw rate"),
    ("MC_RR_INT_LIM", 0.3, 0.0, _INF, "", "limit of the roll rate integrator"),
    ("MC_PR_INT_LIM", 0.3, 0.0, _INF, "", "limit of the pitch rate integrator"),
    ("MC_YR_INT_LIM", 0.3, 0.0, _INF, "", "limit of the yaw rate integrator"),
    ("LNDMC_ROT_MAX", 20.0, 0.0, _INF, "deg/s", "largest body rate of a landed vehicle"),
    ("LNDMC_TRIG_TIME", 1.0, 0.1, 10.0, "s", "duration of landing detection"),
    ("LNDMC_XY_VEL_MAX", 1.5, 0.0, _INF, "m/s", "largest horizontal velocity of a landed vehicle"),
    ("LNDMC_Z_VEL_MAX", 0.25, 0.0, _INF, "m/s", "largest vertical velocity of a landed vehicle"),
    ("IMU_GYRO_CUTOFF", 40.0, 0.0, 1000.0, "Hz", "low-pass of the rates; 0: none"),
    ("IMU_DGYRO_CUTOFF", 30.0, 0.0, 1000.0, "Hz", "low-pass of the angular acceleration; 0: none"),
    ("FLW_TGT_ALT_M", 0, 0, 2, "", "reference of FLW_TGT_HT: 0 home, 1 ground below, 2 target"),
    ("FLW_TGT_DST", 8.0, 1.0, _INF, "m", "horizontal distance from a followed target"),
    (
        "FLW_TGT_FA",
        180.0,
        -180.0,
        180.0,
        "",
        "angle from the target's course to the vehicle, degrees clockwise; 180: behind",
    ),
    ("FLW_TGT_HT", 8.0, 8.0, _INF, "m", "height above the reference of FLW_TGT_ALT_M"),
    ("FLW_TGT_MAX_VEL", 5.0, 0.0, 20.0, "", "largest speed around the target, m/s"),
    ("COM_SPOOLUP_TIME", 1.0, 0.0, 30.0, "s", "idle time of the motors between arming and takeoff"),
)

_SLOW_ROWS: tuple[tuple[str, float, float, float, str, str], ...] = (
    ("BAT1_CAPACITY", -1.0, -1.0, 100_000.0, "mAh", "battery capacity; -1: unknown"),
    ("BAT1_N_CELLS", 4, 1, 16, "", "number of battery cells"),
    ("BAT1_R_INTERNAL", 0.005, -1.0, 0.2, "Ohm", "internal resistance of a cell; negative: unknown"),
    ("BAT1_V_CHARGED", 4.05, 3.0, 4.5, "V", "voltage of a full cell"),
    ("BAT1_V_EMPTY", 3.6, 2.0, 4.2, "V", "voltage of an empty cell"),
    ("BAT1_V_LOAD_DROP", 0.1, 0.07, 0.5, "V", "voltage drop of a cell at full throttle"),
    ("BAT_AVRG_CURRENT", 15.0, 0.0, 500.0, "A", "average current assumed for the remaining time"),
    ("BAT_CRIT_THR", 0.07, 0.05, 0.5, "", "charge below which the battery is critical"),
    ("BAT_EMERGEN_THR", 0.05, 0.03, 0.5, "", "charge below which the battery state is an emergency"),
    ("BAT_LOW_THR", 0.15, 0.12, 0.5, "", "charge below which the battery is low"),
    ("CBRK_FLIGHTTERM", 121212, 0, 121_212, "", "121212: warn at the attitude limits; others: terminate the flight"),
    ("CBRK_SUPPLY_CHK", 0, 0, 894_281, "", "894281: skip the battery check, as PX4's simulation does"),
    ("COM_ACT_FAIL_ACT", 0, 0, 4, "", "on motor failure: 0 warning, 1 hold, 2 land, 3 return, 4 terminate"),
    ("COM_ARM_EKF_HGT", 1.0, 0.1, 1.0, "", "largest height innovation, relative to its gate, for arming"),
    ("COM_ARM_EKF_POS", 0.5, 0.1, 1.0, "", "largest position innovation, relative to its gate, for arming"),
    ("COM_ARM_EKF_VEL", 0.5, 0.1, 1.0, "", "largest velocity innovation, relative to its gate, for arming"),
    ("COM_ARM_EKF_YAW", 0.5, 0.1, 1.0, "", "largest heading innovation, relative to its gate, for arming"),
    ("COM_ARM_MIS_REQ", 0, 0, 1, "", "1: arming requires a mission"),
    ("COM_ARM_SWISBTN", 0, 0, 1, "", "1: the arming switch is a button"),
    ("COM_ARM_WO_GPS", 1, 0, 1, "", "1: allow arming without a GPS fix"),
    ("COM_DISARM_LAND", 2.0, -1.0, _INF, "s", "time from landing to disarming; 0 or negative: never"),
    ("COM_DISARM_PRFLT", 10.0, -1.0, _INF, "s", "time from arming to disarming without takeoff; 0 or negative: never"),
    ("COM_DL_LOSS_T", 10, 5, 300, "s", "timeout of the ground station link"),
    ("COM_FAIL_ACT_T", 5.0, 0.0, 25.0, "s", "time in hold before a failsafe action, for the pilot to take over"),
    ("COM_FLTMODE1", -1, -1, 13, "", "mode of the first position of the mode switch"),
    ("COM_FLTMODE2", -1, -1, 13, "", "mode of the second position"),
    ("COM_FLTMODE3", -1, -1, 13, "", "mode of the third position"),
    ("COM_FLTMODE4", -1, -1, 13, "", "mode of the fourth position"),
    ("COM_FLTMODE5", -1, -1, 13, "", "mode of the fifth position"),
    ("COM_FLTMODE6", -1, -1, 13, "", "mode of the sixth position"),
    ("COM_FLT_TIME_MAX", -1, -1, 10_000, "s", "flight time after which the vehicle returns; -1: unlimited"),
    ("COM_HOME_EN", 1, 0, 1, "", "1: set the home position at arming"),
    ("COM_KILL_DISARM", 5.0, 0.0, 30.0, "s", "time from the kill switch to disarming"),
    ("COM_LKDOWN_TKO", 3.0, -1.0, 5.0, "s", "time after spool-up in which a failure disarms the vehicle"),
    ("COM_LOW_BAT_ACT", 2, 0, 3, "", "on a critical battery: 0 warning, 1 return, 2 land, 3 return, finally land"),
    ("COM_MOT_TEST_EN", 1, 0, 1, "", "allow motor tests by command while disarmed"),
    ("COM_OBL_RC_ACT", 0, 0, 7, "", "on offboard loss: 0 to 2 manual, 3 RTL, 4 land, 5 hold, 6 terminate, 7 disarm"),
    ("COM_OF_LOSS_T", 1.0, 0.0, 60.0, "s", "timeout of the setpoint stream"),
    ("COM_POSCTL_NAVL", 0, 0, 1, "", "on position loss in POSCTL: 0 altitude or manual control, 1 land or descend"),
    ("COM_POS_FS_DELAY", 1, 1, 100, "s", "time without a position before the failsafe"),
    ("COM_POS_FS_EPH", 5.0, -1.0, 400.0, "m", "horizontal error above which the position is invalid; 0 or less: any"),
    ("COM_RCL_EXCEPT", 0, 0, 31, "", "modes without manual control: 1 mission, 2 hold, 4 offboard"),
    ("COM_RC_ARM_HYST", 1000, 100, 1500, "ms", "duration of the arming gesture"),
    ("COM_RC_IN_MODE", 1, 0, 4, "", "manual control by: 0 radio, 1 joystick, 2 either, 3 the first to arrive, 4 none"),
    ("COM_RC_LOSS_T", 0.5, 0.0, 35.0, "s", "timeout of manual control"),
    ("COM_RC_OVERRIDE", 1, 0, 3, "", "modes in which moved sticks take over: 1 AUTO, 2 OFFBOARD"),
    ("COM_RC_STICK_OV", 30.0, 5.0, 80.0, "%", "stick movement that takes over"),
    ("CA_FAILURE_MODE", 0, 0, 1, "", "1: reallocate the thrust of a failed motor to the others"),
    ("FD_ACT_EN", 1, 0, 1, "", "1: detect motor failures by current"),
    ("FD_ACT_MOT_C2T", 2.0, 0.0, 50.0, "A", "motor current per throttle below which a motor has failed"),
    ("FD_ACT_MOT_THR", 0.2, 0.0, 1.0, "", "least throttle for motor failure detection"),
    ("FD_ACT_MOT_TOUT", 100, 10, 10_000, "ms", "time to motor failure detection"),
    ("FD_FAIL_P", 60, 0, 180, "deg", "pitch above which the attitude has failed; 0: no limit"),
    ("FD_FAIL_P_TTRI", 0.3, 0.02, 5.0, "s", "time above FD_FAIL_P before the failure"),
    ("FD_FAIL_R", 60, 0, 180, "deg", "roll above which the attitude has failed; 0: no limit"),
    ("FD_FAIL_R_TTRI", 0.3, 0.02, 5.0, "s", "time above FD_FAIL_R before the failure"),
    ("FLW_TGT_RS", 0.1, 0.0, 1.0, "", "smoothing of a followed target's motion: 0.1 least, 1 most"),
    ("GF_ACTION", 2, 0, 5, "", "on a geofence breach: 0 none, 1 warning, 2 hold, 3 return, 4 terminate, 5 land"),
    ("MAN_ARM_GESTURE", 1, 0, 1, "", "1: arm and disarm by stick, throttle down and yaw to the side"),
    ("MAV_COMP_ID", 1, 1, 250, "", "MAVLink component id, set by the fleet"),
    ("MAV_PROTO_VER", 2, 0, 2, "", "MAVLink version: 0 start with 1, 1 always 1, 2 start with 2"),
    ("MAV_SYS_ID", 1, 1, 250, "", "MAVLink system id, set by the fleet"),
    ("MAV_TYPE", 2, 0, 22, "", "MAV_TYPE of the heartbeat"),
    ("GF_MAX_HOR_DIST", 0.0, 0.0, 10000.0, "m", "largest horizontal distance from home; 0: no limit"),
    ("GF_MAX_VER_DIST", 0.0, 0.0, 10000.0, "m", "largest height above home; 0: no limit"),
    ("GF_PREDICT", 0, 0, 1, "", "1: check the predicted stopping position instead of the present one"),
    ("GF_SOURCE", 0, 0, 1, "", "position source of the geofence: 0 estimate, 1 GPS"),
    ("MC_ORBIT_RAD_MAX", 1000.0, 1.0, 10000.0, "m", "largest radius of an orbit"),
    ("MIS_DIST_1WP", 900.0, -1.0, 100000.0, "m", "largest distance to a mission's first waypoint; 0 or less: any"),
    ("MIS_PD_TO", 5.0, 0.0, _INF, "s", "time allowed for a gripper or winch in a mission"),
    ("MIS_TKO_LAND_REQ", 0, 0, 4, "", "required mission items: 1 takeoff, 2 landing, 3 both, 4 both or neither"),
    ("MIS_YAW_ERR", 12.0, 0.0, 90.0, "deg", "largest heading error at a waypoint with a heading"),
    ("MIS_YAW_TMT", -1.0, -1.0, 20.0, "s", "positive: do not wait for a waypoint's heading"),
    ("MPC_YAW_MODE", 0, 0, 4, "", "heading in AUTO: 0, 4 to the goal, 1 to home, 2 away from home, 3 along the path"),
    ("NAV_LOITER_RAD", 80.0, 25.0, 1000.0, "m", "distance at which a loiter to an altitude starts to climb"),
    ("PLD_BTOUT", 5.0, 0.0, 50.0, "s", "timeout of a landing target"),
    ("PLD_FAPPR_ALT", 0.1, 0.0, 10.0, "m", "height above a landing target below which it is no longer tracked"),
    ("PLD_HACC_RAD", 0.2, 0.0, 10.0, "m", "largest horizontal distance from a landing target to start the descent"),
    ("PLD_MAX_SRCH", 3, 0, 100, "", "largest number of searches for a landing target"),
    ("PLD_SRCH_ALT", 10.0, 0.0, 100.0, "m", "height above home of the search for a landing target"),
    ("PLD_SRCH_TOUT", 10.0, 0.0, 100.0, "s", "duration of a search for a landing target"),
    ("RTL_PLD_MD", 0, 0, 2, "", "precision landing after a return: 0 off, 1 if a target is visible, 2 with a search"),
    ("RTL_TYPE", 0, 0, 3, "", "return to: 0 home or rally point, 1, 2 mission landing, 3 the closest of them"),
    ("MIS_TAKEOFF_ALT", 2.5, 0.0, 80.0, "m", "least takeoff height above home"),
    ("MPC_XY_MAN_EXPO", 0.6, 0.0, 1.0, "", "curve of the horizontal sticks: 0 linear, 1 cubic"),
    ("MPC_YAW_EXPO", 0.6, 0.0, 1.0, "", "curve of the yaw stick"),
    ("MPC_Z_MAN_EXPO", 0.6, 0.0, 1.0, "", "curve of the throttle stick"),
    ("NAV_DLL_ACT", 0, 0, 6, "", "on ground station loss: 0 none, 1 hold, 2 return, 3 land, 5 terminate, 6 disarm"),
    ("NAV_RCL_ACT", 2, 1, 6, "", "on loss of manual control: 1 hold, 2 return, 3 land, 5 terminate, 6 disarm"),
    ("RC_ARMSWITCH_TH", 0.75, -1.0, 1.0, "", "threshold of the arming switch; negative: reversed"),
    ("RC_KILLSWITCH_TH", 0.75, -1.0, 1.0, "", "threshold of the kill switch"),
    ("RC_LOITER_TH", 0.75, -1.0, 1.0, "", "threshold of the hold switch"),
    ("RC_MAP_ARM_SW", 0, 0, 18, "", "channel of the arming switch; 0: none"),
    ("RC_MAP_FLTMODE", 0, 0, 18, "", "channel of the mode switch"),
    ("RC_MAP_KILL_SW", 0, 0, 18, "", "channel of the kill switch"),
    ("RC_MAP_LOITER_SW", 0, 0, 18, "", "channel of the hold switch"),
    ("RC_MAP_OFFB_SW", 0, 0, 18, "", "channel of the offboard switch"),
    ("RC_MAP_PITCH", 0, 0, 18, "", "channel of the pitch stick"),
    ("RC_MAP_RETURN_SW", 0, 0, 18, "", "channel of the return switch"),
    ("RC_MAP_ROLL", 0, 0, 18, "", "channel of the roll stick"),
    ("RC_MAP_THROTTLE", 0, 0, 18, "", "channel of the throttle stick"),
    ("RC_MAP_YAW", 0, 0, 18, "", "channel of the yaw stick"),
    ("RC_OFFB_TH", 0.75, -1.0, 1.0, "", "threshold of the offboard switch"),
    ("RC_RETURN_TH", 0.75, -1.0, 1.0, "", "threshold of the return switch"),
    ("RTL_CONE_ANG", 45, 0, 90, "deg", "half angle of the cone above home that lowers the return altitude; 0: no cone"),
    ("RTL_DESCEND_ALT", 10.0, 0.0, _INF, "m", "height above home to which a return descends before landing"),
    ("RTL_LAND_DELAY", 0.0, -1.0, _INF, "s", "waiting time at RTL_DESCEND_ALT; negative: hold there"),
    ("RTL_MIN_DIST", 10.0, 0.5, _INF, "m", "distance from home within which the cone applies"),
    ("RTL_RETURN_ALT", 30.0, 0.0, _INF, "m", "least height above home of a return"),
    ("RTL_TIME_FACTOR", 1.1, 1.0, 2.0, "", "factor on the estimated time of a return"),
    ("RTL_TIME_MARGIN", 100, 0, 3600, "s", "margin added to the estimated time of a return"),
    ("SDLOG_MODE", 1, -1, 4, "", "log: -1 never, 0 while armed, 1 from boot to disarming, 2 from boot, 4 from arming"),
    ("SDLOG_UTC_OFFSET", 0, -1000, 1000, "min", "local time minus UTC, for log names"),
    ("SYS_FAILURE_EN", 1, 0, 1, "", "1: allow failure injection, as in PX4's simulation"),
    ("SIM_BAT_DRAIN", 60.0, 1.0, 86_400.0, "s", "time to drain the simulated battery"),
    ("SIM_BAT_MIN_PCT", 50.0, 0.0, 100.0, "%", "charge at which the simulated battery stops draining"),
    ("SYS_AUTOSTART", 10015, 0, 9_999_999, "", "airframe number"),
)  # fmt: skip


def _parameter(row: tuple[str, float, float, float, str, str]) -> Parameter:
    name, default, minimum, maximum, unit, text = row
    kind = INT32 if isinstance(default, int) else FLOAT
    return Parameter(name, kind, default, minimum, maximum, unit, text)


def _channel_rows() -> tuple[tuple[str, float, float, float, str, str], ...]:
    """Return the calibration of the 18 radio channels."""
    rows: list[tuple[str, float, float, float, str, str]] = []
    for number in range(1, 19):
        dead_zone = 10.0 if number <= 8 else 0.0
        rows += [
            (f"RC{number}_DZ", dead_zone, 0.0, 100.0, "us", f"dead zone of channel {number} around its middle"),
            (f"RC{number}_MAX", 2000.0, 1500.0, 2200.0, "us", f"largest pulse of channel {number}"),
            (f"RC{number}_MIN", 1000.0, 800.0, 1500.0, "us", f"least pulse of channel {number}"),
            (f"RC{number}_REV", 1.0, -1.0, 1.0, "", f"-1: channel {number} is reversed"),
            (f"RC{number}_TRIM", 1500.0, 800.0, 2200.0, "us", f"middle of channel {number}"),
        ]
    return tuple(rows)


def _table() -> dict[str, Parameter]:
    """Return every parameter by name, sorted as PX4 lists them."""
    table = {row[0]: _parameter(row) for row in _KERNEL_ROWS + _SLOW_ROWS + _channel_rows()}
    for row in inert_parameters.rows():
        table[row[0]] = replace(_parameter((*row, "stored, without effect in this simulation")), has_effect=False)
    return dict(sorted(table.items()))


_TABLE: dict[str, Parameter] = _table()
_FIELDS: dict[str, str] = {row[0]: row[0].lower() for row in _KERNEL_ROWS}

NAMES: tuple[str, ...] = tuple(_TABLE)  # sorted
INDEX: dict[str, int] = {name: index for index, name in enumerate(NAMES)}  # as PARAM_VALUE.param_index
PARAMS = np.dtype([(field, "f8") for field in _FIELDS.values()], align=True)


def describe(name: str) -> Parameter:
    """Return the definition of the parameter ``name``.

    Raises:
        ParameterError: there is no such parameter.
    """
    entry = _TABLE.get(name)
    if entry is None:
        raise ParameterError(f"parameter {name!r} does not exist")
    return entry


def _checked(entry: Parameter, value: float) -> int | float:
    """Return ``value`` converted to the parameter's type.

    Raises:
        ParameterError: not finite, a fraction for an integer, or out of the type's range.
    """
    if not math.isfinite(value):
        raise ParameterError(f"{entry.name}: {value} is not a finite number")
    if entry.type == INT32:
        if value != int(value) or not _INT32_RANGE[0] <= value <= _INT32_RANGE[1]:
            raise ParameterError(f"{entry.name}: {value} is not a 32-bit integer")
        return int(value)
    if abs(value) > _FLOAT_MAX:
        raise ParameterError(f"{entry.name}: {value} is too large for a 32-bit float")
    return float(value)


class Parameters:
    """The parameters of one vehicle.

    A value out of its sensible range is stored, with a warning, as PX4 does.

    Attributes:
        changes: number of value changes.
        on_change: callback of the logger for every value change, with name and new value; may be None.
    """

    def __init__(self, overrides: Mapping[str, float] | None = None, file: Path | None = None) -> None:
        """Initialise with the defaults, then load ``file``.

        Args:
            overrides: defaults of the airframe and the world that replace PX4's, by name.
            file: parameter file, loaded now and written by ``save``; None for none.

        Raises:
            ParameterError: an unknown name or a value that the parameter cannot hold, in ``overrides``.
        """
        self._record: Any = None
        self._file = file
        self.on_change: Callable[[str, int | float], None] | None = None
        self.changes = 0
        self._defaults = {name: entry.default for name, entry in _TABLE.items()}
        self._values: dict[str, int | float] = dict(self._defaults)
        for name, value in (overrides or {}).items():
            self.set(name, value)
        self._defaults = dict(self._values)
        self.load()

    def get(self, name: str) -> int | float:
        """Return the value of a parameter, int or float by its type.

        Raises:
            ParameterError: there is no such parameter.
        """
        value = self._values.get(name)
        if value is None:
            raise ParameterError(f"parameter {name!r} does not exist")
        return value

    def default(self, name: str) -> int | float:
        """Return the vehicle's default of a parameter: the airframe's if it has one, else PX4's.

        Raises:
            ParameterError: there is no such parameter.
        """
        value = self._defaults.get(name)
        if value is None:
            raise ParameterError(f"parameter {name!r} does not exist")
        return value

    def set(self, name: str, value: float, kind: int | None = None) -> int | float:
        """Store ``value``, update the attached record, and return the value in the parameter's type.

        Args:
            name: PX4's name.
            value: number; whole for an INT32 parameter.
            kind: type declared by the sender, ``INT32`` or ``FLOAT``; None to skip the check.

        Raises:
            ParameterError: an unknown name, a type other than ``kind``, or a value that the type cannot hold.
        """
        entry = describe(name)
        if kind is not None and kind != entry.type:
            raise ParameterError(f"{name}: type {kind} is not allowed, its MAV_PARAM_TYPE is {entry.type}")
        stored = _checked(entry, value)
        if not entry.minimum <= stored <= entry.maximum:
            _log.warning("%s: %s is outside %s..%s %s", name, stored, entry.minimum, entry.maximum, entry.unit)
        changed = stored != self._values[name]
        self._values[name] = stored
        if self._record is not None and name in _FIELDS:
            self._record[_FIELDS[name]] = stored
        if changed:
            self.changes += 1
            if self.on_change is not None:
                self.on_change(name, stored)
        return stored

    def reset(self) -> None:
        """Reset all parameters to the vehicle's defaults."""
        for name, value in self._defaults.items():
            self.set(name, value)

    def load(self) -> None:
        """Load the file, and reset parameters that it does not contain; do nothing without a file.

        Rows with an unknown name, a wrong type or an invalid value are skipped with a warning.
        """
        if self._file is None:
            return
        self.reset()
        for name, value, kind in parameter_file.read_rows(self._file):
            if name in _FIXED and value != self._values[name]:
                _log.warning("parameter file %s: %s = %s is skipped, as the fleet sets it", self._file, name, value)
                continue
            try:
                self.set(name, value, kind)
            except ParameterError as error:
                _log.warning("parameter file %s: skipped: %s", self._file, error)

    def save(self) -> bool:
        """Write the values other than defaults to the file; return False on an error. Do nothing without a file."""
        if self._file is None:
            return True
        changed = [
            (name, value, _TABLE[name].type) for name, value in self._values.items() if value != self._defaults[name]
        ]
        try:
            system, component = int(self._values["MAV_SYS_ID"]), int(self._values["MAV_COMP_ID"])
            parameter_file.write_changed(self._file, changed, system, component)
        except OSError as error:
            _log.warning("parameters cannot be saved: %s: %s", self._file, error.strerror or error)
            return False
        return True

    def write_to(self, record: Any) -> None:
        """Attach ``record``, one element of a ``PARAMS`` array: write the kernel parameters now and at every change."""
        self._record = record
        for name, field in _FIELDS.items():
            record[field] = self._values[name]

    def hash(self) -> int:
        """Return PX4's CRC-32 over all names and values, with which a ground station validates its cached list."""
        crc = 0
        for name in NAMES:
            value = self._values[name]
            data = name.encode() + pack("<i" if isinstance(value, int) else "<f", value)
            # PX4 starts from 0 and does not invert; zlib inverts before and after
            crc = zlib.crc32(data, crc ^ _CRC_FLIP) ^ _CRC_FLIP
        return crc
