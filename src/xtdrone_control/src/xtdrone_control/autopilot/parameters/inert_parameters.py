"""PX4 v1.14's parameters without effect here: stored, listed and saved, for compatibility with scripts for a real PX4.

A parameter that becomes effective moves from this table to ``parameters``. Names, types, defaults, ranges and units are
those of a PX4 v1.14.3 SITL build (its parameter metadata; ``docs/parameters.md`` lists the groups).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from xtdrone_control.autopilot.parameters.derived_records import SLOTS
from xtdrone_control.autopilot.state import MAX_ROTORS

Row = tuple[str, float, float, float, str]
"""Name, default, minimum, maximum, unit; an int as default makes the parameter an INT32."""

_INF = math.inf

_ROWS: tuple[Row, ...] = (
    ("ASPD_SCALE_1", 1.0, 0.5, 2.0, ""),
    ("BAT_N_CELLS", 3, -_INF, _INF, ""),
    ("BAT_V_CHARGED", 4.05, -_INF, _INF, ""),
    ("BAT_V_EMPTY", 3.6, -_INF, _INF, ""),
    ("BAT_V_LOAD_DROP", 0.3, -_INF, _INF, ""),
    ("CAL_AIR_CMODEL", 0, 0, 2, ""),
    ("CAL_AIR_TUBED_MM", 1.5, 1.5, 100.0, "mm"),
    ("CAL_AIR_TUBELEN", 0.2, 0.01, 2.0, "m"),
    ("CAL_MAG_COMP_TYP", 0, 0, 3, ""),
    ("CAL_MAG_SIDES", 63, 0, 63, ""),
    ("CA_AIRFRAME", 0, 0, 14, ""),
    ("CBRK_AIRSPD_CHK", 0, 0, 162128, ""),
    ("CBRK_BUZZER", 0, 0, 782097, ""),
    ("CBRK_IO_SAFETY", 22027, 0, 22027, ""),
    ("CBRK_USB_CHK", 197848, 0, 197848, ""),
    ("CBRK_VTOLARMING", 0, 0, 159753, ""),
    ("COM_ARM_ARSP_EN", 1, 0, 1, ""),
    ("COM_ARM_AUTH_ID", 10, -_INF, _INF, ""),
    ("COM_ARM_AUTH_MET", 0, 0, 1, ""),
    ("COM_ARM_AUTH_REQ", 0, 0, 1, ""),
    ("COM_ARM_AUTH_TO", 1.0, -_INF, _INF, "s"),
    ("COM_ARM_CHK_ESCS", 0, 0, 1, ""),
    ("COM_ARM_HFLT_CHK", 1, 0, 1, ""),
    ("COM_ARM_IMU_ACC", 0.7, 0.1, 1.0, "m/s^2"),
    ("COM_ARM_IMU_GYR", 0.25, 0.02, 0.3, "rad/s"),
    ("COM_ARM_MAG_ANG", 60, 3, 180, "deg"),
    ("COM_ARM_MAG_STR", 2, 0, 2, ""),
    ("COM_ARM_SDCARD", 1, 0, 2, ""),
    ("COM_CPU_MAX", 95.0, -1.0, 100.0, "%"),
    ("COM_FLT_PROFILE", 0, 0, 300, ""),
    ("COM_FORCE_SAFETY", 0, 0, 1, ""),
    ("COM_HLDL_LOSS_T", 120, 60, 3600, "s"),
    ("COM_HLDL_REG_T", 0, 0, 60, "s"),
    ("COM_IMB_PROP_ACT", 0, -1, 2, ""),
    ("COM_OBC_LOSS_T", 5.0, 0.0, 60.0, "s"),
    ("COM_OBS_AVOID", 0, 0, 1, ""),
    ("COM_PARACHUTE", 0, 0, 1, ""),
    ("COM_POS_LOW_EPH", -1.0, -1.0, _INF, "m"),
    ("COM_POWER_COUNT", 1, 0, 4, ""),
    ("COM_PREARM_MODE", 0, 0, 2, ""),
    ("COM_QC_ACT", 0, -1, 2, ""),
    ("COM_VEL_FS_EVH", 1.0, 0.0, _INF, "m/s"),
    ("COM_WIND_MAX", -1.0, -1.0, _INF, "m/s"),
    ("COM_WIND_WARN", -1.0, -1.0, _INF, "m/s"),
    ("EKF2_ABL_ACCLIM", 25.0, 20.0, 200.0, "m/s^2"),
    ("EKF2_ABL_GYRLIM", 3.0, 2.0, 20.0, "rad/s"),
    ("EKF2_ABL_TAU", 0.5, 0.1, 1.0, "s"),
    ("EKF2_ARSP_THR", 0.0, 0.0, _INF, "m/s"),
    ("EKF2_ASPD_MAX", 20.0, 5.0, 50.0, "m/s"),
    ("EKF2_ASP_DELAY", 100.0, 0.0, 300.0, "ms"),
    ("EKF2_AVEL_DELAY", 5.0, 0.0, 300.0, "ms"),
    ("EKF2_BCOEF_X", 100.0, 0.0, 200.0, "kg/m^2"),
    ("EKF2_BCOEF_Y", 100.0, 0.0, 200.0, "kg/m^2"),
    ("EKF2_BETA_GATE", 5.0, 1.0, _INF, "SD"),
    ("EKF2_BETA_NOISE", 0.3, 0.1, 1.0, "m/s"),
    ("EKF2_DECL_TYPE", 7, 0, 7, ""),
    ("EKF2_DRAG_CTRL", 0, 0, 1, ""),
    ("EKF2_DRAG_NOISE", 2.5, 0.5, 10.0, "(m/s^2)^2"),
    ("EKF2_EAS_NOISE", 1.4, 0.5, 5.0, "m/s"),
    ("EKF2_FUSE_BETA", 0, 0, 1, ""),
    ("EKF2_GND_EFF_DZ", 4.0, 0.0, 10.0, "m"),
    ("EKF2_GND_MAX_HGT", 0.5, 0.0, 5.0, "m"),
    ("EKF2_GRAV_NOISE", 1.0, 0.1, 10.0, "m/s^2"),
    ("EKF2_GSF_TAS", 15.0, 0.0, 100.0, "m/s"),
    ("EKF2_MAG_ACCLIM", 0.5, 0.0, 5.0, "m/s^2"),
    ("EKF2_MAG_DELAY", 0.0, 0.0, 300.0, "ms"),
    ("EKF2_MAG_E_NOISE", 0.001, 0.0, 0.1, "gauss/s"),
    ("EKF2_MAG_GATE", 3.0, 1.0, _INF, "SD"),
    ("EKF2_MAG_YAWLIM", 0.2, 0.0, 1.0, "rad/s"),
    ("EKF2_MCOEF", 0.15, 0.0, 1.0, "1/s"),
    ("EKF2_MULTI_IMU", 0, 0, 4, ""),
    ("EKF2_OF_QMIN_GND", 0, 0, 255, ""),
    ("EKF2_PCOEF_XN", 0.0, -0.5, 0.5, ""),
    ("EKF2_PCOEF_XP", 0.0, -0.5, 0.5, ""),
    ("EKF2_PCOEF_YN", 0.0, -0.5, 0.5, ""),
    ("EKF2_PCOEF_YP", 0.0, -0.5, 0.5, ""),
    ("EKF2_PCOEF_Z", 0.0, -0.5, 0.5, ""),
    ("EKF2_PREDICT_US", 10000, 1000, 20000, "us"),
    ("EKF2_REQ_HDRIFT", 0.1, 0.1, 1.0, "m/s"),
    ("EKF2_REQ_VDRIFT", 0.2, 0.1, 1.5, "m/s"),
    ("EKF2_RNG_A_IGATE", 1.0, 0.1, 5.0, "SD"),
    ("EKF2_RNG_K_GATE", 1.0, 0.1, 5.0, "SD"),
    ("EKF2_RNG_PITCH", 0.0, -0.75, 0.75, "rad"),
    ("EKF2_RNG_QLTY_T", 1.0, 0.1, 5.0, "s"),
    ("EKF2_SEL_ERR_RED", 0.2, -_INF, _INF, ""),
    ("EKF2_SEL_IMU_ACC", 1.0, -_INF, _INF, "m/s^2"),
    ("EKF2_SEL_IMU_ANG", 15.0, -_INF, _INF, "deg"),
    ("EKF2_SEL_IMU_RAT", 7.0, -_INF, _INF, "deg/s"),
    ("EKF2_SEL_IMU_VEL", 2.0, -_INF, _INF, "m/s"),
    ("EKF2_SYNT_MAG_Z", 0, 0, 1, ""),
    ("EKF2_TAS_GATE", 3.0, 1.0, _INF, "SD"),
    ("EKF2_TAU_POS", 0.25, 0.1, 1.0, "s"),
    ("EKF2_TAU_VEL", 0.25, -_INF, 1.0, "s"),
    ("EKF2_TERR_GRAD", 0.5, 0.0, _INF, "m/m"),
    ("EKF2_TERR_MASK", 3, 0, 3, ""),
    ("EKF2_WIND_NSD", 0.01, 0.0, 1.0, "m/s^2/sqrt(Hz)"),
    ("FD_ESCS_EN", 1, 0, 1, ""),
    ("FD_EXT_ATS_EN", 0, 0, 1, ""),
    ("FD_EXT_ATS_TRIG", 1900, -_INF, _INF, "us"),
    ("FD_IMB_PROP_THR", 30, 0, 1000, ""),
    ("FW_AIRSPD_MAX", 20.0, 0.5, _INF, "m/s"),
    ("FW_AIRSPD_TRIM", 15.0, 0.5, _INF, "m/s"),
    ("FW_ARSP_MODE", 0, 0, 1, ""),
    ("FW_PSP_OFF", 0.0, -90.0, 90.0, "deg"),
    ("FW_T_CLMB_R_SP", 3.0, 0.5, 15.0, "m/s"),
    ("FW_T_SINK_R_SP", 2.0, 0.5, 15.0, "m/s"),
    ("GF_ALTMODE", 0, 0, 1, ""),
    ("GF_COUNT", -1, -1, 10, ""),
    ("GND_SPEED_THR_SC", 1.0, 0.005, 50.0, "%m/s"),
    ("IMU_ACCEL_CUTOFF", 30.0, 0.0, 1000.0, "Hz"),
    ("IMU_GYRO_CAL_EN", 1, 0, 1, ""),
    ("IMU_GYRO_DNF_BW", 15.0, 5.0, 30.0, "Hz"),
    ("IMU_GYRO_DNF_EN", 0, 0, 3, ""),
    ("IMU_GYRO_DNF_HMC", 3, 1, 7, ""),
    ("IMU_GYRO_DNF_MIN", 25.0, -_INF, _INF, "Hz"),
    ("IMU_GYRO_NF0_BW", 20.0, 0.0, 100.0, "Hz"),
    ("IMU_GYRO_NF0_FRQ", 0.0, 0.0, 1000.0, "Hz"),
    ("IMU_GYRO_NF1_BW", 20.0, 0.0, 100.0, "Hz"),
    ("IMU_GYRO_NF1_FRQ", 0.0, 0.0, 1000.0, "Hz"),
    ("IMU_GYRO_RATEMAX", 400, 100, 2000, "Hz"),
    ("IMU_INTEG_RATE", 200, 100, 1000, "Hz"),
    ("LNDMC_ALT_GND", 2.0, -1.0, _INF, "m"),
    ("LNDMC_ALT_MAX", -1.0, -1.0, 10000.0, "m"),
    ("MAV_FWDEXTSP", 1, 0, 1, ""),
    ("MAV_HASH_CHK_EN", 1, 0, 1, ""),
    ("MAV_HB_FORW_EN", 1, 0, 1, ""),
    ("MAV_RADIO_TOUT", 5, 1, 250, "s"),
    ("MAV_SIK_RADIO_ID", 0, -1, 240, ""),
    ("MAV_USEHILGPS", 0, 0, 1, ""),
    ("MC_AT_APPLY", 1, 0, 2, ""),
    ("MC_AT_EN", 0, 0, 1, ""),
    ("MC_AT_RISE_TIME", 0.14, 0.01, 0.5, "s"),
    ("MC_AT_START", 0, 0, 1, ""),
    ("MC_AT_SYSID_AMP", 0.7, 0.1, 6.0, ""),
    ("MC_BAT_SCALE_EN", 0, 0, 1, ""),
    ("MIS_LND_ABRT_ALT", 30, 0, _INF, "m"),
    ("MIS_MNT_YAW_CTL", 0, 0, 1, ""),
    ("MNT_MODE_IN", -1, -1, 4, ""),
    ("MOT_SLEW_MAX", 0.0, 0.0, _INF, "s/(1000*PWM)"),
    ("MPC_LAND_ALT3", 1.0, 0.0, 122.0, "m"),
    ("MPC_LAND_RADIUS", 1000.0, 0.0, _INF, "m"),
    ("MPC_LAND_RC_HELP", 0, 0, 1, ""),
    ("NAV_FORCE_VT", 1, 0, 1, ""),
    ("NAV_FW_ALTL_RAD", 5.0, 0.05, 200.0, "m"),
    ("NAV_FW_ALT_RAD", 10.0, 0.05, 200.0, "m"),
    ("NAV_MIN_LTR_ALT", -1.0, -1.0, _INF, "m"),
    ("NAV_TRAFF_AVOID", 1, 0, 4, ""),
    ("NAV_TRAFF_A_HOR", 500.0, 500.0, _INF, "m"),
    ("NAV_TRAFF_A_VER", 500.0, 10.0, 500.0, "m"),
    ("NAV_TRAFF_COLL_T", 60, 1, 900000000, "s"),
    ("PD_GRIPPER_EN", 0, 0, 1, ""),
    ("PWM_MAIN_REV", 0, 0, 65535, ""),
    ("RC_CHAN_CNT", 0, 0, 18, ""),
    ("RC_ENG_MOT_TH", 0.75, -1.0, 1.0, ""),
    ("RC_FAILS_THR", 0, 0, 2200, "us"),
    ("RC_GEAR_TH", 0.75, -1.0, 1.0, ""),
    ("RC_MAP_FLTM_BTN", 0, 0, 258048, ""),
    ("RC_TRANS_TH", 0.75, -1.0, 1.0, ""),
    ("RTL_LOITER_RAD", 80.0, 25.0, _INF, "m"),
    ("SDLOG_BOOT_BAT", 0, 0, 1, ""),
    ("SDLOG_DIRS_MAX", 0, 0, 1000, ""),
    ("SDLOG_MISSION", 0, 0, 2, ""),
    ("SDLOG_PROFILE", 1, 0, 2047, ""),
    ("SDLOG_UUID", 1, 0, 1, ""),
    ("SENS_BARO_QNH", 1013.25, 500.0, 1500.0, "hPa"),
    ("SENS_BARO_RATE", 20.0, 1.0, 200.0, "Hz"),
    ("SENS_DPRES_OFF", 0.0, -_INF, _INF, ""),
    ("SENS_EN_BAROSIM", 0, 0, 1, ""),
    ("SENS_EN_GPSSIM", 0, 0, 1, ""),
    ("SENS_EN_MAGSIM", 0, 0, 1, ""),
    ("SENS_GPS_MASK", 7, 0, 7, ""),
    ("SENS_GPS_PRIME", 0, -1, 1, ""),
    ("SENS_GPS_TAU", 10.0, 1.0, 100.0, "s"),
    ("SENS_IMU_AUTOCAL", 1, 0, 1, ""),
    ("SENS_IMU_MODE", 1, 0, 1, ""),
    ("SENS_MAG_AUTOCAL", 1, 0, 1, ""),
    ("SENS_MAG_AUTOROT", 1, 0, 1, ""),
    ("SENS_MAG_MODE", 1, 0, 1, ""),
    ("SENS_MAG_RATE", 15.0, 1.0, 200.0, "Hz"),
    ("SENS_MAG_SIDES", 63, 34, 63, ""),
    ("SIM_BARO_OFF_P", 0.0, -_INF, _INF, ""),
    ("SIM_BARO_OFF_T", 0.0, -_INF, _INF, "degC"),
    ("SIM_GPS_USED", 10, 0, 50, ""),
    ("SIM_MAG_OFFSET_X", 0.0, -_INF, _INF, "gauss"),
    ("SIM_MAG_OFFSET_Y", 0.0, -_INF, _INF, "gauss"),
    ("SIM_MAG_OFFSET_Z", 0.0, -_INF, _INF, "gauss"),
    ("SYS_AUTOCONFIG", 0, 0, 1, ""),
    ("SYS_AUTOSTART", 10015, 0, 9999999, ""),
    ("SYS_CAL_TDEL", 24, 10, _INF, "degC"),
    ("SYS_CAL_TMAX", 10, -_INF, _INF, "degC"),
    ("SYS_CAL_TMIN", 5, -_INF, _INF, "degC"),
    ("SYS_FAC_CAL_MODE", 0, 0, 2, ""),
    ("SYS_HAS_NUM_DIST", 0, 0, 4, ""),
    ("SYS_HITL", 0, -1, 2, ""),
    ("SYS_MC_EST_GROUP", 2, 1, 3, ""),
    ("SYS_STCK_EN", 1, 0, 1, ""),
    ("VTO_LOITER_ALT", 80.0, 20.0, 300.0, "m"),
    ("VT_B_DEC_MSS", 2.0, 0.5, 10.0, "m/s^2"),
    ("WV_EN", 0, 0, 1, ""),
    ("WV_GAIN", 1.0, 0.0, 3.0, "Hz"),
    ("WV_ROLL_MIN", 1.0, 0.0, 5.0, "deg"),
    ("WV_YRATE_MAX", 90.0, 0.0, 120.0, "deg/s"),
)  # fmt: skip

_SLOTS = 4  # sensor instances with PX4 parameters
_ROTORS = 12
_MAIN_OUTPUTS = 16
_RADIO_SWITCHES = (
    "ACRO_SW", "AUX1", "AUX2", "AUX3", "AUX4", "AUX5", "AUX6", "ENG_MOT", "FAILSAFE", "FLAPS", "GEAR_SW", "MAN_SW",
    "MODE_SW", "PARAM1", "PARAM2", "PARAM3", "POSCTL_SW", "RATT_SW", "STAB_SW", "TRANS_SW",
)  # fmt: skip


def _calibration_rows() -> Iterator[Row]:
    """Yield what the simulated sensors lack: further instances, mounts of their own, and currents beside them."""
    for slot in range(_SLOTS):
        yield f"CAL_BARO{slot}_ID", 0, -_INF, _INF, ""
        for sensor, slots in SLOTS.items():
            if slot >= slots:
                yield f"CAL_{sensor}{slot}_ID", 0, -_INF, _INF, ""
            if slot < slots or sensor == "MAG":
                yield f"CAL_{sensor}{slot}_ROT", -1, -1, 40, ""
    for slot in range(SLOTS["MAG"]):
        for axis in "XYZ":
            yield f"CAL_MAG{slot}_{axis}COMP", 0.0, -_INF, _INF, ""


def _allocation_rows() -> Iterator[Row]:
    """Yield rotors that no vehicle has, and slew rates."""
    yield "CA_R_REV", 0, 0, 4095, ""
    for rotor in range(_ROTORS):
        yield f"CA_R{rotor}_SLEW", 0.0, 0.0, 10.0, "s"
    for rotor in range(MAX_ROTORS, _ROTORS):
        for axis, direction in (("X", 0.0), ("Y", 0.0), ("Z", -1.0)):
            yield f"CA_ROTOR{rotor}_A{axis}", direction, -100.0, 100.0, ""
            yield f"CA_ROTOR{rotor}_P{axis}", 0.0, -100.0, 100.0, "m"
        yield f"CA_ROTOR{rotor}_CT", 6.5, 0.0, 100.0, ""
        yield f"CA_ROTOR{rotor}_KM", 0.05, -1.0, 1.0, ""
    for servo in range(8):
        yield f"CA_SV{servo}_SLEW", 0.0, 0.0, 10.0, "s"


def _output_rows() -> Iterator[Row]:
    for output in range(1, _MAIN_OUTPUTS + 1):
        yield f"PWM_MAIN_FUNC{output}", 0, 0, _INF, ""


def _radio_rows() -> Iterator[Row]:
    for switch in _RADIO_SWITCHES:
        yield f"RC_MAP_{switch}", 0, 0, 18, ""


def rows() -> tuple[Row, ...]:
    """Return the rows of all parameters without effect, unsorted."""
    return (*_ROWS, *_calibration_rows(), *_allocation_rows(), *_output_rows(), *_radio_rows())
