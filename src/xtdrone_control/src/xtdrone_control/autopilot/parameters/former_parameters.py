"""Parameters of PX4 v1.11 that v1.14 has renamed or removed.

Scripts and parameter files of XTDrone name them: XTDrone flies v1.11.0-beta1. Source: the parameter definitions of PX4
v1.11.0-beta1 and -beta2 against those of v1.14, ``param_translation.cpp`` and the descriptions of the commits that
removed a name. Parameters of other vehicle types, boards and drivers are left out, and so are those of outputs (PWM_*).
"""

from __future__ import annotations

_RENAMED = {
    "BAT_CAPACITY": "BAT1_CAPACITY",
    "BAT_R_INTERNAL": "BAT1_R_INTERNAL",
    "BAT_SOURCE": "BAT1_SOURCE",
    "CAL_ACC0_EN": "CAL_ACC0_PRIO",
    "CAL_ACC1_EN": "CAL_ACC1_PRIO",
    "CAL_ACC2_EN": "CAL_ACC2_PRIO",
    "CAL_ACC_PRIME": "CAL_ACC0_PRIO",
    "CAL_GYRO0_EN": "CAL_GYRO0_PRIO",
    "CAL_GYRO1_EN": "CAL_GYRO1_PRIO",
    "CAL_GYRO2_EN": "CAL_GYRO2_PRIO",
    "CAL_GYRO_PRIME": "CAL_GYRO0_PRIO",
    "CAL_MAG0_EN": "CAL_MAG0_PRIO",
    "CAL_MAG1_EN": "CAL_MAG1_PRIO",
    "CAL_MAG_PRIME": "CAL_MAG0_PRIO",
    "CBRK_ENGINEFAIL": "FD_ACT_EN",
    "CBRK_VELPOSERR": "COM_POS_FS_EPH",
    "COM_ARM_AUTH": "COM_ARM_AUTH_ID COM_ARM_AUTH_MET COM_ARM_AUTH_TO",
    "COM_EF_C2T": "FD_ACT_MOT_C2T",
    "COM_EF_THROT": "FD_ACT_MOT_THR",
    "COM_EF_TIME": "FD_ACT_MOT_TOUT",
    "COM_OBL_ACT": "COM_OBL_RC_ACT",
    "EKF2_AID_MASK": "EKF2_GPS_CTRL EKF2_EV_CTRL EKF2_OF_CTRL EKF2_DRAG_CTRL EKF2_IMU_CTRL",
    "EKF2_GPS_MASK": "SENS_GPS_MASK",
    "EKF2_GPS_TAU": "SENS_GPS_TAU",
    "EKF2_HGT_MODE": "EKF2_HGT_REF",
    "EKF2_MAGBIAS_ID": "CAL_MAG0_ID",
    "EKF2_MAGBIAS_X": "CAL_MAG0_XOFF",
    "EKF2_MAGBIAS_Y": "CAL_MAG0_YOFF",
    "EKF2_MAGBIAS_Z": "CAL_MAG0_ZOFF",
    "EKF2_RNG_AID": "EKF2_RNG_CTRL",
    "EKF2_WIND_NOISE": "EKF2_WIND_NSD",
    "IMU_GYRO_NF_BW": "IMU_GYRO_NF0_BW",
    "IMU_GYRO_NF_FREQ": "IMU_GYRO_NF0_FRQ",
    "MIS_LTRMIN_ALT": "MIS_LND_ABRT_ALT",
    "MIS_TAKEOFF_REQ": "MIS_TKO_LAND_REQ",
    "MPC_SPOOLUP_TIME": "COM_SPOOLUP_TIME",
    "MPC_XY_VEL_D": "MPC_XY_VEL_D_ACC",
    "MPC_XY_VEL_I": "MPC_XY_VEL_I_ACC",
    "MPC_XY_VEL_P": "MPC_XY_VEL_P_ACC",
    "MPC_Z_VEL_D": "MPC_Z_VEL_D_ACC",
    "MPC_Z_VEL_I": "MPC_Z_VEL_I_ACC",
    "MPC_Z_VEL_P": "MPC_Z_VEL_P_ACC",
    "NAV_FT_DST": "FLW_TGT_DST",
    "NAV_FT_FS": "FLW_TGT_FA",
    "NAV_FT_RS": "FLW_TGT_RS",
    "NAV_MIN_FT_HT": "FLW_TGT_HT",
    "NAV_TRAFF_A_RADM": "NAV_TRAFF_A_HOR NAV_TRAFF_A_VER",
    "NAV_TRAFF_A_RADU": "NAV_TRAFF_A_HOR NAV_TRAFF_A_VER",
    "SIM_ACCEL_BLOCK": "SYS_FAILURE_EN",
    "SIM_BARO_BLOCK": "SYS_FAILURE_EN",
    "SIM_GPS_BLOCK": "SYS_FAILURE_EN",
    "SIM_GYRO_BLOCK": "SYS_FAILURE_EN",
    "SIM_MAG_BLOCK": "SYS_FAILURE_EN",
}

_REMOVED = frozenset(
    [
        "CBRK_RATE_CTRL",
        "COM_ARM_EKF_AB",
        "COM_ARM_EKF_GB",
        "COM_HOME_H_T",
        "COM_HOME_V_T",
        "COM_POS_FS_EPV",
        "COM_POS_FS_GAIN",
        "COM_POS_FS_PROB",
        "EKF2_IMU_ID",
        "EKF2_MAGB_K",
        "EKF2_MAGB_VREF",
        "EKF2_MIN_OBS_DT",
        "EKF2_MOVE_TEST",
        "LNDMC_FFALL_THR",
        "LNDMC_FFALL_TTRI",
        "LNDMC_LOW_T_THR",
        "MAV_ODOM_LP",
        "MC_RATT_TH",
        "MIS_ALTMODE",
        "MIS_DIST_WPS",
        "MOT_ORDERING",
        "MPC_DEC_HOR_SLOW",
        "MPC_JERK_MIN",
        "MPC_LAND_VEL_XY",
        "NAV_AH_ALT",
        "NAV_AH_LAT",
        "NAV_AH_LON",
        "NAV_GPSF_LT",
        "NAV_GPSF_P",
        "NAV_GPSF_R",
        "NAV_GPSF_TR",
        "RC_ACRO_TH",
        "RC_ASSIST_TH",
        "RC_AUTO_TH",
        "RC_FLT_CUTOFF",
        "RC_FLT_SMP_RATE",
        "RC_MAN_TH",
        "RC_POSCTL_TH",
        "RC_RATT_TH",
        "RC_STAB_TH",
        "SYS_PARAM_VER",
        "SYS_RESTART_TYPE",
    ]
)

NAMES = frozenset(_RENAMED) | _REMOVED
"""All former names. EKF2_AID_MASK still exists in v1.14, without effect here."""


def replacements(name: str) -> tuple[str, ...]:
    """Return the current parameters that replace a former one; empty if it has no successor or is not a former one."""
    return tuple(_RENAMED.get(name, "").split())


def hint(name: str) -> str:
    """Return a phrase on the successors of a former parameter, for the end of a message; empty for all other names."""
    if name in _REMOVED:
        return ": PX4 v1.11 had it, v1.14 has nothing in its place"
    today = replacements(name)
    return f": PX4 v1.14 has {', '.join(today)} in its place" if today else ""
