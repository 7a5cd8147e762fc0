"""Each value of each parameter that no kernel reads acts: a probe computes something else than with the default.

A probe is a function of the parameters that exercises one part of the autopilot without ROS and kernels; ``TABLE``
has the probe of each parameter. Parameters in ``FLOWN`` act in a flight only, which the named test flies. Those
of kernels are in ``test_effect_of_parameters``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mission_fakes import NAN, MissionFlight, at

from xtdrone_autopilot.commander.failsafe import Failsafe, Flags, Situation, mode_fallback, triggered
from xtdrone_autopilot.commander.health_and_arming_checks.battery_estimate import BatteryEstimate
from xtdrone_autopilot.commander.health_and_arming_checks.failure_detector import FailureDetector
from xtdrone_autopilot.commander.manual_control import CENTRED, ManualControl, Sticks
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.parameters.derived_records import DERIVED, DEVICES, SLOTS
from xtdrone_autopilot.parameters.metadata import CHOICES
from xtdrone_autopilot.parameters.parameters import INT32, NAMES, PARAMS, Parameters, describe
from xtdrone_common import modes

Probe = Callable[[Parameters], Any]


class Given(Parameters):
    """Parameters that remember the names which have been set."""

    def __init__(self, values: dict[str, float]) -> None:
        super().__init__()
        self.given = tuple(values)
        for name, value in values.items():
            self.set(name, value)


def given(p: Parameters) -> tuple[str, ...]:
    return p.given if isinstance(p, Given) else ()


# ---- probes


def battery(p: Parameters) -> Any:
    """Return what the battery estimate says while a battery of 3 to 6 cells is emptied."""
    found = []
    for current in (-1.0, 20.0):
        estimate = BatteryEstimate(p.get)
        for k in range(400):
            estimate.update(k * 200_000, 16.8 - 0.02 * k, current, 0.5, True)
            found.append((estimate.remaining, estimate.warning, str(estimate.time_remaining)))
    return found


def failures(p: Parameters) -> Any:
    """Return when attitude and motors are found to fail, by tilt and by current."""
    flight = MissionFlight()
    view, autopilot = flight.commander.view, flight.autopilot
    detector = FailureDetector(view, p.get)
    autopilot.sensors[0]["esc_current"][:4] = 5.0
    found = []
    for k in range(200):
        tilt = math.radians(0.9 * k)
        q = (math.cos(tilt / 2), *((math.sin(tilt / 2), 0.0) if k % 100 < 50 else (0.0, math.sin(tilt / 2))), 0.0)
        autopilot.estimator[0]["q"] = q
        autopilot.control[0]["actuators"][:4] = (0.005 * k, 0.2, 0.2, 0.2)
        autopilot.sensors[0]["esc_current"][:1] = 0.3
        detector.update(k * 10_000, True, True)
        found.append((detector.roll, detector.pitch, detector.motors, int(autopilot.setpoint[0]["failed_rotors"])))
    return found


def failsafe(p: Parameters) -> Any:
    """Return the actions for every single flag in every mode, alone and with manual control lost, and a delayed one."""
    found: list[Any] = []
    single = [Flags(**{name: True}) for name in Flags._fields if name != "battery"]
    single += [Flags(battery=level) for level in range(4)]
    for mode in (modes.POSCTL, modes.AUTO_MISSION, modes.AUTO_LOITER, modes.OFFBOARD):
        for flags in [*single, *(flag._replace(manual_lost=True) for flag in single)]:
            for starting in (False, True):
                options = triggered(Situation(True, mode, starting), flags, p.get)
                found.append(sorted((name, option.action) for name, option in options.items()))
            found.append(mode_fallback(mode, flags, p.get))
    for flags in (Flags(gcs_lost=True), Flags(attitude_failure=True)):
        course = Failsafe(p.get, modes.AUTO_LOITER)
        for k in range(400):
            outcome = course.update(k * 100_000, k > 2, modes.AUTO_LOITER, flags if k > 10 else Flags())
            found.append((outcome.action, outcome.delayed))
    return found


def radio(p: Parameters) -> Any:
    """Return sticks, switches and requests while sticks and switches of a radio and a joystick move."""
    manual = ManualControl(p.get)
    found: list[Any] = []
    for k in range(1, 160):
        phase = math.sin(0.37 * k)
        pulses = [round(1500 + 500 * math.sin((0.13 + 0.031 * n) * k)) for n in range(18)]
        if 60 <= k < 90:  # an arming gesture
            pulses = [1500, 1500, 1000, 2000, *pulses[4:]]
        if k > 5 and (k % 3 or k < 100):
            manual.radio(pulses, k * 100_000)
        if k % 4 == 0 and not 20 < k < 60:
            manual.joystick(Sticks(0.3 * phase, 0.0, 0.2, 0.0) if k % 8 else CENTRED, k * 100_000)
        if k > 140:
            continue
        requests = manual.update(k * 100_000)
        found.append((manual.sticks, dict(manual.switches), requests, manual.moving, manual.by_radio))
    for k in range(160, 190):
        found.append((manual.update(k * 50_000 + 8_000_000), manual.sticks))
    return found


def channels(p: Parameters) -> Any:
    """Return the position of each channel by its pulse, used for all sticks."""
    found = []
    for number in range(1, 19):
        q = Parameters({"COM_RC_IN_MODE": 0} | {f"RC_MAP_{a}": number for a in ("ROLL", "PITCH", "THROTTLE", "YAW")})
        for name in given(p):
            q.set(name, p.get(name))
        manual = ManualControl(q.get)
        for pulse in (950, 1100, 1400, 1505, 1700, 2050):
            manual.radio([pulse] * 18, 1_000_000)
            found.append(manual.sticks)
    return found


def records(p: Parameters) -> Any:
    """Return the records that are computed from many parameters, with the vehicle's own sensors in each slot."""
    found = []
    for own in range(max(SLOTS.values())):
        q = Parameters()
        for sensor, slots in SLOTS.items():
            for slot in range(slots):
                q.set(f"CAL_{sensor}{slot}_ID", DEVICES[sensor] if slot == own else 0)
                q.set(f"CAL_{sensor}{slot}_XOFF", 0.125)
        for name in given(p):
            q.set(name, p.get(name))
        record = np.zeros(1, PARAMS)
        q.write_to(record[0])
        found += [record[field].tobytes() for field, *_ in DERIVED]
    return found


def values(p: Parameters) -> Any:
    """Return all values after one of them has been set."""
    return {name: p.get(name) for name in NAMES if name not in given(p)}


def flight_with(p: Parameters) -> MissionFlight:
    flight = MissionFlight()
    for name in given(p):
        flight.parameters.set(name, p.get(name))
    return flight


def watched(
    flight: MissionFlight, seconds: float, each: Callable[[int], None] | None = None, every: int = 1
) -> list[Any]:
    """Return goals, texts, modes and flags of a flight that reaches its goals at once every ``every`` updates."""
    found: list[Any] = []
    for k in range(round(seconds * 10)):
        if each is not None:
            each(k)
        if k % every == 0:
            flight.follow()
        flight.run(0.1)
        c = flight.commander
        found.append((flight.goal(), flight.texts(), str(c.mode), c.armed, int(flight.setpoint["task"])))
        found.append(str(flight.setpoint["goal_yaw"]) + str(flight.setpoint["velocity"]))
    return found


def returning(p: Parameters) -> Any:
    """Return the course of a return from inside and outside the cone, with a rally point and a mission landing."""
    found = []
    for place in ((7.0, 0.0), (60.0, 30.0)):
        flight = flight_with(p)
        flight.hover()
        flight.load(at(0, 0, command=plan.TAKEOFF), at(40, 0), at(45, 25, 0, plan.LAND))
        flight.load(at(62, 33, 0, plan.RALLY_POINT), kind=plan.RALLY)
        flight.place(*place, -12.0, 0.7)
        flight.commander.request(modes.AUTO_RTL)
        found += watched(flight, 16.0)
        flight = flight_with(p)
        flight.hover()
        flight.place(*place, -12.0, 0.7)
        flight.commander.request(modes.AUTO_RTL)
        found += watched(flight, 16.0)
    return found


def precise(p: Parameters) -> Any:
    """Return the course of landings on a target that moves, is lost, or is never seen."""
    found = []
    for seen in (lambda k: k < 5, lambda k: k < 40, lambda k: False, lambda k: 20 < k < 30):
        flight = flight_with(p)
        flight.hover()
        landing = flight.commander.navigator.precision_landing

        def look(k: int, flight: MissionFlight = flight, landing: Any = landing, seen: Any = seen) -> None:
            if k > 12:
                flight.place(0.15, 0.0, -max(6.0 - 0.2 * k, 0.04))
            if seen(k):
                landing.see((0.02 * k, 0.3, 0.0), flight.autopilot.time_us)

        flight.commander.request(modes.AUTO_PRECLAND)
        found += watched(flight, 24.0, look)
    return found


def sticks(p: Parameters) -> Any:
    """Return what sticks command, and the answers to a drifting estimate, lost links and limits."""
    found: list[Any] = []
    flight = flight_with(p)
    flight.parameters.set("COM_RC_IN_MODE", 1)
    flight.hover()
    flight.commander.gcs_heartbeat()
    fields = ("stick_x", "stick_y", "stick_z", "stick_yaw")

    def move(k: int) -> None:
        flight.commander.manual.joystick(Sticks(0.03 * k % 1.0, 0.05, -0.3, 0.5), flight.autopilot.time_us)
        flight.place(0.5 * k, 0.0, -10.0 - 0.5 * k)
        found.append([float(flight.setpoint[field]) for field in fields])
        found.append((flight.commander.health.flags, flight.commander.health.breach))

    for mode in (modes.POSCTL, modes.AUTO_LOITER, modes.OFFBOARD):
        flight.commander.request(mode)
        found += watched(flight, 6.0, move)
    flight.commander.commands.orbit(700.0, 2.0, 0.0, (NAN, NAN, NAN))
    found.append(flight.texts())
    found += watched(flight, 15.0, move)
    for variance in (0.0, 4.0, 9.0, 30.0, 1000.0, 0.0):
        P = flight.autopilot.estimator[0]["P"]
        P[6, 6] = P[7, 7] = variance
        found += watched(flight, 2.0, move)
    return found


def mission(p: Parameters) -> Any:
    """Return the course of a mission, and of uploads that may be refused."""
    found: list[Any] = []
    for items in (
        (at(0, 0, command=plan.TAKEOFF), at(20, 0, 12), at(20, 20, 12), at(0, 20, 0, plan.LAND)),
        (at(0, 0, command=plan.TAKEOFF), at(20, 0, 12)),
        (at(20, 0, 12), at(30, 0, 12)),
        (at(950, 0, 12), at(960, 0, 12, plan.LAND)),
        (at(0, 0, command=plan.TAKEOFF), at(70, 0, 12, plan.LOITER_TO_ALT, 0.0, NAN), at(40, 0, 30), at(40, 40, 30)),
        (at(0, 0, command=plan.TAKEOFF), at(20, 0, 12, plan.WAYPOINT, 0.0, 0.0, 0.0, 30.0), at(20, 20, 12)),
    ):
        flight = flight_with(p)
        flight.load(*items)
        found.append(flight.texts())
        found.append(flight.commander.request(modes.AUTO_MISSION))
        found.append(flight.commander.arm_disarm(True))
        found += watched(flight, 12.0, every=7)
    return found


def ground(p: Parameters) -> Any:
    """Return arming, disarming and reports of a vehicle on the ground and after a landing."""
    found: list[Any] = []
    flight = flight_with(p)
    for field in ("vel", "pos", "hgt", "mag"):
        for step in range(12):
            flight.autopilot.estimator["test_ratio"][field] = 0.1 * step
            flight.run(0.1)
            found.append(flight.commander.arming_denial())
        flight.autopilot.estimator["test_ratio"][field] = 0.0
    for field, value in (("gps_fix", 2), ("battery_voltage", 0.0)):
        flight = flight_with(p)
        flight.autopilot.sensors[field] = value
        flight.run(1.0)
        found.append(flight.commander.arming_denial())
    flight = flight_with(p)
    flight.run(1.0)
    found.append(flight.commander.arm_disarm(True))
    flight.run(12.0, lambda: found.append(flight.commander.armed))
    flight.commander.arm_disarm(True)
    flight.place(3.0, 0.0, -5.0)
    flight.run(1.0)
    flight.commander.kill(True)
    flight.run(8.0, lambda: found.append(flight.commander.armed))
    flight.commander.kill(False)
    flight.commander.arm_disarm(True)
    flight.run(0.5)
    flight.place(3.0, 0.0, 0.0)
    flight.run(4.0, lambda: found.append(flight.commander.armed))
    found.append([flight.parameters.get(name) for name in ("COM_FLIGHT_UUID", "LND_FLIGHT_T_LO", "LND_FLIGHT_T_HI")])
    return [*found, flight.commander.health.battery.connected]


# ---- the table

TABLE: dict[Probe, Iterable[str]] = {
    battery: (
        "BAT1_CAPACITY", "BAT1_N_CELLS", "BAT1_R_INTERNAL", "BAT1_V_CHARGED", "BAT1_V_EMPTY", "BAT1_V_LOAD_DROP",
        "BAT_AVRG_CURRENT", "BAT_CRIT_THR", "BAT_EMERGEN_THR", "BAT_LOW_THR",
    ),
    failures: (
        "CA_FAILURE_MODE", "FD_ACT_EN", "FD_ACT_MOT_C2T", "FD_ACT_MOT_THR", "FD_ACT_MOT_TOUT", "FD_FAIL_P",
        "FD_FAIL_P_TTRI",
        "FD_FAIL_R", "FD_FAIL_R_TTRI",
    ),
    failsafe: (
        "CBRK_FLIGHTTERM", "COM_ACT_FAIL_ACT", "COM_FAIL_ACT_T", "COM_LOW_BAT_ACT", "COM_OBL_RC_ACT", "COM_RCL_EXCEPT",
        "GF_ACTION", "NAV_DLL_ACT", "NAV_RCL_ACT", "COM_LKDOWN_TKO", "COM_POSCTL_NAVL",
    ),
    radio: (
        "COM_ARM_SWISBTN", *(f"COM_FLTMODE{slot}" for slot in range(1, 7)), "COM_RC_ARM_HYST", "COM_RC_IN_MODE",
        "COM_RC_LOSS_T", "COM_RC_STICK_OV", "MAN_ARM_GESTURE", "RC_ARMSWITCH_TH", "RC_KILLSWITCH_TH", "RC_LOITER_TH",
        "RC_MAP_ARM_SW", "RC_MAP_FLTMODE", "RC_MAP_KILL_SW", "RC_MAP_LOITER_SW", "RC_MAP_OFFB_SW", "RC_MAP_PITCH",
        "RC_MAP_RETURN_SW", "RC_MAP_ROLL", "RC_MAP_THROTTLE", "RC_MAP_YAW", "RC_OFFB_TH", "RC_RETURN_TH",
    ),
    channels: [name for name in NAMES if re.match(r"RC\d", name)],
    precise: (
        "LTEST_MODE", "PLD_BTOUT", "PLD_FAPPR_ALT", "PLD_HACC_RAD", "PLD_MAX_SRCH", "PLD_SRCH_ALT", "PLD_SRCH_TOUT",
    ),
    sticks: (
        "COM_RC_OVERRIDE", "MC_ORBIT_RAD_MAX", "MPC_HOLD_DZ", "MPC_XY_MAN_EXPO", "MPC_YAW_EXPO", "MPC_Z_MAN_EXPO",
        "COM_POS_FS_EPH", "COM_POS_FS_DELAY", "GF_MAX_HOR_DIST", "GF_MAX_VER_DIST", "COM_FLT_TIME_MAX", "COM_DL_LOSS_T",
    ),
    records: sorted({name for *_, names in DERIVED for name in names}),
    values: ("EKF2_AID_MASK", "MPC_XY_VEL_ALL", "MPC_Z_VEL_ALL", "SYS_VEHICLE_RESP"),
    returning: (
        "RTL_CONE_ANG", "RTL_DESCEND_ALT", "RTL_HDG_MD", "RTL_LAND_DELAY", "RTL_MIN_DIST", "RTL_PLD_MD",
        "RTL_RETURN_ALT",
        "RTL_TYPE",
    ),
    mission: ("MIS_DIST_1WP", "MIS_TAKEOFF_ALT", "MIS_TKO_LAND_REQ", "MIS_YAW_ERR", "MIS_YAW_TMT", "NAV_LOITER_RAD"),
    ground: (
        "BAT1_SOURCE", "CBRK_SUPPLY_CHK", "COM_ARM_EKF_HGT", "COM_ARM_EKF_POS", "COM_ARM_EKF_VEL", "COM_ARM_EKF_YAW",
        "COM_ARM_MIS_REQ", "COM_ARM_WO_GPS", "COM_DISARM_LAND", "COM_DISARM_PRFLT", "COM_FLIGHT_UUID",
        "COM_KILL_DISARM",
        "LND_FLIGHT_T_HI", "LND_FLIGHT_T_LO",
    ),
}  # fmt: skip

BASE: dict[Probe, dict[str, float]] = {
    radio: {
        "RC_MAP_ROLL": 1, "RC_MAP_PITCH": 2, "RC_MAP_THROTTLE": 3, "RC_MAP_YAW": 4, "RC_MAP_ARM_SW": 5,
        "RC_MAP_FLTMODE": 6,
        "RC_MAP_KILL_SW": 7, "RC_MAP_LOITER_SW": 8, "RC_MAP_OFFB_SW": 9, "RC_MAP_RETURN_SW": 10, "COM_RC_IN_MODE": 0,
    },
    battery: {"BAT1_CAPACITY": 500.0},
    failures: {"CA_FAILURE_MODE": 1},
    precise: {"PLD_MAX_SRCH": 1},
    mission: {"MIS_YAW_TMT": -1.0},
    failsafe: {"NAV_DLL_ACT": 2},
    values: {"EKF2_EV_CTRL": 0},
}  # fmt: skip
"""Values of others with which a probe shows its parameters."""

VALUES: dict[str, list[float]] = {
    **{f"CAL_{sensor}{slot}_PRIO": [0.0] for sensor, slots in SLOTS.items() for slot in range(slots)},
    "COM_ARM_EKF_HGT": [0.2],
    "COM_FLT_TIME_MAX": [3.0],
    "GF_MAX_HOR_DIST": [10.0],
    "GF_MAX_VER_DIST": [10.0],
    "COM_RCL_EXCEPT": [1.0, 2.0, 4.0],
    "EKF2_AID_MASK": [2.0, 4.0, 8.0, 16.0, 256.0],
}
"""Values to try instead of all choices, or of one on each side of the default."""
SAME: dict[str, set[float]] = {}
"""Values that mean the same as the default."""

FLOWN: dict[str, str] = {
    **dict.fromkeys(("COM_HOME_EN", "COM_HOME_IN_AIR"), "test_home_position.py"),
    "COM_MOT_TEST_EN": "test_motor_test.py",
    "COM_OF_LOSS_T": "test_stack.py",
    "COM_TAKEOFF_ACT": "test_navigator.py",
    "FLW_TGT_RS": "test_follow_target.py",
    **dict.fromkeys(("GF_PREDICT", "GF_SOURCE"), "test_return.py"),
    **{
        f"LTEST_{name}": "test_landing_target_estimator.py"
        for name in ("ACC_UNC", "MEAS_UNC", "POS_UNC_IN", "VEL_UNC_IN")
    },
    "MAV_COMP_ID": "test_fuzzed_autopilot.py",
    "MAV_PROTO_VER": "test_mavlink_clients.py",
    "MAV_SYS_ID": "test_command_acks.py",
    "MIS_PD_TO": "test_mission_flight.py",
    "MPC_YAW_MODE": "test_mission_execution.py",
    **dict.fromkeys(("SDLOG_MODE", "SDLOG_UTC_OFFSET"), "test_flight_log.py"),
    **dict.fromkeys(("SIM_BAT_DRAIN", "SIM_BAT_MIN_PCT"), "test_failsafe_flight.py"),
    "SYS_FAILURE_EN": "test_command_acks.py",
}
"""Parameters without a probe, by the test that flies them or sends their messages."""

TELEMETRY = {"MAV_TYPE", "RTL_TIME_FACTOR", "RTL_TIME_MARGIN"}
"""Parameters that act in telemetry only, in HEARTBEAT and the estimated time of a return."""


def candidates(name: str) -> list[float]:
    """Return the values to try of a parameter: all choices, else one on each side of the default within its range."""
    entry = describe(name)
    if name in VALUES:
        return VALUES[name]
    if name in CHOICES:
        return [float(value) for value in CHOICES[name] if value not in SAME.get(name, set())]
    found = []
    for limit, step in ((entry.maximum, 1.0), (entry.minimum, -1.0)):
        value = entry.default + 0.5 * (limit - entry.default) if math.isfinite(limit) else entry.default + step
        value = float(round(value + 0.49 * step)) if entry.type == INT32 else value
        if value != entry.default:
            found.append(value)
    return found


@pytest.mark.parametrize("probe", TABLE, ids=lambda probe: probe.__name__)
def test_every_value_acts(probe: Probe) -> None:
    base = BASE.get(probe, {})
    computed = {"": probe(Given(base))}
    idle = {}
    for name in TABLE[probe]:
        before = base.get(name, describe(name).default)
        tried = [value for value in candidates(name) if value != before]
        same = [value for value in tried if probe(Given(base | {name: value})) == computed[""]]
        if same if name in CHOICES or name in VALUES else len(same) == len(tried):
            idle[name] = same
    assert not idle, "\n".join(f"{name} {found}" for name, found in idle.items())


def test_every_parameter_has_a_probe_or_a_flight() -> None:
    """A flight's test names its parameter."""
    names = {name for name in NAMES if describe(name).effect == "other"}
    probed = [name for found in TABLE.values() for name in found]
    assert len(probed) == len(set(probed))
    assert set(probed) | set(FLOWN) | TELEMETRY == names
    assert not set(FLOWN) & set(probed)
    packages = Path(__file__).parents[2]
    for name, file in FLOWN.items():
        (path,) = (*packages.glob(f"*/tests/{file}"), *packages.parent.glob(f"tests/{file}"))
        assert re.search(rf"\b{name}\b", path.read_text(encoding="utf-8")), f"{name} is not in {file}"
