"""Each parameter that the kernels read acts: a flight's samples and setpoints, replayed with another value of it.

One vehicle takes off, flies two legs and lands. Its samples are then fed to many vehicles at once, one for each value
of each parameter, with setpoints of all flight tasks in between; each vehicle must compute something else than one with
the default. Parameters that act on a branch only have their branch in ``BRANCHES``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from xtdrone_autopilot.autopilot import STEP_US, Autopilot, step_all
from xtdrone_autopilot.parameters.metadata import CHOICES
from xtdrone_autopilot.parameters.parameters import INT32, NAMES, Parameters, describe
from xtdrone_autopilot.state import (
    N_STATES,
    OBSTACLE_UNKNOWN,
    TASK_ACRO,
    TASK_ALTITUDE,
    TASK_ATTITUDE,
    TASK_DESCEND,
    TASK_FOLLOW,
    TASK_MANUAL,
    TASK_ORBIT,
    TASK_RATES,
    TASK_STICKS,
    TASK_TRAJECTORY,
)
from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.simulation import Simulation

NAN = math.nan
ARMED, LEGS, TASKS, LANDING, END = 7.0, 15.0, 22.0, 33.5, 47.0  # s, begin of each part of the flight


@dataclass(frozen=True)
class Branch:
    """What a parameter needs to act.

    Attributes:
        parameters: values of others.
        samples: values of sensor fields; what is added to one if its name ends in "+".
        since: time from which errors and outages in ``samples`` hold, s.
    """

    parameters: dict[str, float] = field(default_factory=dict)
    samples: dict[str, Any] = field(default_factory=dict)
    since: float = 0.0


RANGE = {"range_fresh": 1, "range_quality": 100, "range_least": 0.1, "range_largest": 30.0}
FLOW = {"flow_fresh": 1, "flow_quality": 100, **RANGE}
VISION = {"vision_fresh": 1, "vision_quality": 80}
FLOW_ONLY = {"EKF2_OF_CTRL": 1, "EKF2_GPS_CTRL": 0}
VISION_ONLY = {"EKF2_GPS_CTRL": 0}
PREVENTED = {"MPC_POS_MODE": 3, "CP_DIST": 3.0}
LATER = LEGS + 1.0
BRANCHES: dict[str, Branch] = {
    "EKF2_GPS_P_GATE": Branch(samples={"gps_eph": 2.0, "gps_lat+": 3.6e-5}, since=LATER),
    "EKF2_BARO_GATE": Branch(samples={"baro_alt+": 14.0}, since=LATER),
    "EKF2_ABL_LIM": Branch(samples={"accel+": (0.0, 0.0, 0.5)}),
    "EKF2_GYR_B_LIM": Branch(samples={"gyro+": (0.0, 0.0, 0.12)}),
    "EKF2_REQ_EPH": Branch(samples={"gps_eph": 2.7}),
    "EKF2_REQ_EPV": Branch({"EKF2_GPS_CHECK": 253}, {"gps_epv": 4.0}),
    "EKF2_REQ_SACC": Branch(samples={"gps_speed_accuracy": 1.0}),
    "EKF2_REQ_NSATS": Branch(samples={"gps_satellites": 7}),
    "EKF2_REQ_PDOP": Branch({"EKF2_GPS_CHECK": 247}, {"gps_hdop": 1.7, "gps_vdop": 1.6}),
    "EKF2_GPS_CHECK": Branch(samples={"gps_hdop": 3.0}),
    "EKF2_MAG_CHECK": Branch(samples={"mag+": (0.5, 0.0, 0.0)}, since=LATER),
    "EKF2_NOAID_TOUT": Branch(samples={"gps_fresh": 0}, since=LATER),
    "EKF2_EV_QMIN": Branch(VISION_ONLY, {"vision_fresh": 1, "vision_quality": 30}),
    "EKF2_EV_NOISE_MD": Branch(VISION_ONLY, VISION | {"vision_position_variance": 0.5}),
    "EKF2_EVP_GATE": Branch(VISION_ONLY, VISION | {"vision_position+": (0.3, 0.0, 0.0)}, LATER),
    "EKF2_EVV_GATE": Branch(VISION_ONLY, VISION | {"vision_velocity+": (0.4, 0.0, 0.0)}, LATER),
    **{f"EKF2_{name}": Branch(VISION_ONLY, VISION) for name in ("EV_CTRL", "EVA_NOISE", "EVP_NOISE", "EVV_NOISE")},
    "EKF2_OF_CTRL": Branch(samples=FLOW),
    **{f"EKF2_OF_{name}": Branch(FLOW_ONLY, FLOW) for name in ("N_MIN", "N_MAX", "QMIN")},
    "EKF2_OF_GATE": Branch(FLOW_ONLY, FLOW | {"flow_rate+": (0.8, 0.0)}, LATER),
    **{f"EKF2_RNG_{name}": Branch(samples=RANGE) for name in ("CTRL", "NOISE", "SFE", "A_HMAX", "A_VMAX")},
    "EKF2_MIN_RNG": Branch(samples=RANGE),
    "EKF2_TERR_NOISE": Branch(samples=RANGE),
    "EKF2_RNG_GATE": Branch({"EKF2_RNG_CTRL": 2}, RANGE | {"range_distance+": 0.6}, LATER),
    **{f"EKF2_EV_{name}": Branch(VISION_ONLY, VISION) for name in ("DELAY", "POS_X", "POS_Y", "POS_Z")},
    **{f"EKF2_OF_{name}": Branch(FLOW_ONLY, FLOW) for name in ("DELAY", "POS_X", "POS_Y", "POS_Z")},
    **{f"EKF2_RNG_{name}": Branch(samples=RANGE) for name in ("DELAY", "POS_X", "POS_Y", "POS_Z")},
    "MPC_ALT_MODE": Branch({"MPC_HOLD_MAX_XY": 20.0, "MPC_HOLD_MAX_Z": 0.0}, RANGE),
    "MPC_ACC_HOR_MAX": Branch({"MPC_POS_MODE": 3}),
    "MPC_HOLD_MAX_XY": Branch({"MPC_POS_MODE": 3}),
    "FLW_TGT_ALT_M": Branch(samples=RANGE),
    **{f"CP_{name}": Branch(PREVENTED) for name in ("DELAY", "GUIDE_ANG")},
    "CP_DIST": Branch({"MPC_POS_MODE": 3}),
    "CP_GO_NO_DATA": Branch(PREVENTED | {"CP_GUIDE_ANG": 0.0}),
}
# values that a short flight can distinguish from the default
VALUES: dict[str, list[float]] = {
    "HTE_VXY_THR": [1.0],
    "HTE_VZ_THR": [1.0],
    **{f"EKF2_{name}_GATE": [1.0] for name in ("GPS_P", "EVP", "RNG")},
    "MPC_Z_V_AUTO_UP": [0.5],
    "MPC_TILTMAX_LND": [0.01],
    "MPC_XY_TRAJ_P": [0.1],
    "FLW_TGT_MAX_VEL": [0.5],
    "MPC_HOLD_MAX_XY": [1e-3],
    "MPC_HOLD_MAX_Z": [1e-3],
    **{f"MC_{axis}R_INT_LIM": [0.0] for axis in "RPY"},
    "LNDMC_ROT_MAX": [0.0],
    "LNDMC_XY_VEL_MAX": [0.0],
}
SAME: dict[str, set[int]] = {"EKF2_MAG_TYPE": {1}, "CA_METHOD": {1}}  # choices that mean the same as the default


# ---- the flight


class Recorder:
    """A vehicle that records the samples, setpoints and estimates of every step."""

    def __init__(self) -> None:
        self.simulation = Simulation(parse_fleet("iris"), places=[(0.0, 0.0, 0.0)])
        self.commander = self.simulation.commanders[0]
        self.autopilot = self.simulation.autopilots.autopilot
        self.samples: list[Any] = []
        self.setpoints: list[Any] = []
        self.estimates: list[Any] = []
        step = self.autopilot.step

        def recording() -> None:
            self.samples.append(self.autopilot.sensors.copy())
            self.setpoints.append(self.autopilot.setpoint.copy())
            self.estimates.append(self.autopilot.estimator[["position", "velocity", "q"]].copy())
            step()

        self.autopilot.step = recording

    def run_until(self, seconds: float) -> None:
        while self.simulation.time_us < seconds * 1e6:
            self.simulation.step()  # not run_until, which takes several steps at once


def step_at(seconds: float) -> int:
    return round(seconds * 1e6 / STEP_US)


@pytest.fixture(scope="module")
def flight() -> Recorder:
    recorder = Recorder()
    commander = recorder.commander
    view = commander.view
    commander.parameters.set("MIS_TAKEOFF_ALT", 6.0)
    recorder.run_until(ARMED)
    assert commander.commands.takeoff(NAN, NAN) == 0
    assert commander.arm_disarm(True) == 0
    recorder.run_until(LEGS)
    assert not view.landed
    x, y, z = view.position
    view.setpoint["climb_speed"] = NAN
    course = commander.navigator._course
    course.fly_to((x + 14.0, y, z - 4.0), 1.0, onward=(x + 14.0, y + 12.0, z - 4.0))
    recorder.run_until(LEGS + 5.5)
    course.fly_to((x + 14.0, y + 12.0, z + 1.0), 1.0)
    recorder.run_until(LANDING)
    assert commander.request(modes.AUTO_LAND) == 0
    recorder.run_until(END)
    return recorder


# ---- the replay


@dataclass
class Case:
    """One vehicle of the replay: ``parameters`` in addition to its branch."""

    name: str
    value: float
    branch: Branch
    base: int = 0
    acts: bool = False


def candidates(name: str) -> list[float]:
    """Return other values of a parameter: all of a choice, else one on each side within its range."""
    entry = describe(name)
    if name in VALUES:
        return VALUES[name]
    if name in CHOICES:
        return [value for value in CHOICES[name] if value != entry.default]
    found = []
    for limit, step in ((entry.maximum, 1.0), (entry.minimum, -1.0)):
        value = entry.default + 0.5 * (limit - entry.default) if math.isfinite(limit) else entry.default + step
        value = float(round(value + 0.49 * step)) if entry.type == INT32 else value
        if value != entry.default:
            found.append(value)
    return found


def every_case() -> list[Case]:
    """Return a default vehicle for each branch, followed by the vehicles with another value."""
    bases: dict[str, int] = {}
    cases: list[Case] = []
    for name in ["", *(name for name in NAMES if describe(name).effect == "kernel")]:
        branch = BRANCHES.get(name, Branch())
        key = repr(branch)
        if key not in bases:
            bases[key] = len(cases)
            cases.append(Case("", 0.0, branch, len(cases), True))
        cases += [Case(name, value, branch, bases[key]) for value in (candidates(name) if name else [])]
    return cases


def outputs(control: Any, estimator: Any) -> list[Any]:
    """Return what a vehicle does and reports, one array per field, rows by vehicle."""
    found = [control[field] for field in ("actuators", "sp_q", "sp_rates", "sp_thrust", "task_yaw_rate")]
    found += [control[field] for field in ("task_velocity", "task_position")]
    found += [control["landing"][field] for field in ("landed", "maybe_landed", "ground_contact")]
    found += [estimator[field] for field in ("q", "velocity", "position", "flags", "eph", "gps_good", "mag_good")]
    found += [estimator[field] for field in ("position_valid", "terrain", "vision_good", "flow_good")]
    return [np.nan_to_num(array).reshape(len(array), -1) for array in found]


class Replay:
    """All cases at once; those that have differed from their default vehicle leave."""

    def __init__(self, flight: Recorder, cases: list[Case]) -> None:
        self.cases = cases
        n = len(cases)
        self.autopilot = Autopilot(flight.autopilot._layouts * n, flight.autopilot._datum)
        for case, row in zip(cases, self.autopilot.params, strict=True):
            values = dict(case.branch.parameters)
            if case.name:
                values[case.name] = case.value
            Parameters(flight.commander.parameters._values | values).write_to(row)
        self.autopilot.start_control()
        self.indices = np.arange(n)
        self.arrays = {
            name: getattr(self.autopilot, name).copy()
            for name in ("sensors", "estimator", "setpoint", "control", "params", "mix", "unmix", "rotors")
        }
        self.work = np.zeros((2, N_STATES))

    def keep(self, which: Any) -> None:
        self.indices = self.indices[which]
        self.arrays = {name: array[which].copy() for name, array in self.arrays.items()}

    def step(self, k: int, sample: Any, setpoint: Any, estimate: Any) -> None:
        arrays = self.arrays
        arrays["sensors"][:] = sample
        arrays["setpoint"][:] = setpoint
        for row, index in enumerate(self.indices):
            branch = self.cases[index].branch
            if branch.samples:
                late = k >= step_at(branch.since)
                found = {name: value for name, value in branch.samples.items() if late or not disturbs(name, value)}
                apply(arrays["sensors"], row, found, k, estimate)
        step_all(*(arrays[name] for name in NAMES_OF_ARGUMENTS[:8]), STEP_US * 1e-6, self.work)

    def see_obstacles(self, k: int) -> None:
        """Fill the maps of collision prevention: walls with gaps that turn; nothing known behind without guidance."""
        found = self.arrays["control"]["obstacles"]
        found["time_us"] = found["times_us"] = k * STEP_US
        found["ranges"], found["least"], found["largest"] = 1000.0, 20.0, 1000.0
        found["distances"] = 350.0
        found["distances"][:, k // 25 % 9 :: 9] = 900.0
        unguided = np.flatnonzero(self.arrays["params"]["cp_guide_ang"] == 0.0)
        found["distances"][unguided, 4:27] = OBSTACLE_UNKNOWN

    def compare(self) -> None:
        """Mark the cases that differ from their default vehicle, and let them leave."""
        rows = {int(index): row for row, index in enumerate(self.indices)}
        base = np.array([rows[self.cases[index].base] for index in self.indices])
        different = np.zeros(len(base), bool)
        for array in outputs(self.arrays["control"], self.arrays["estimator"]):
            different |= (array != array[base]).any(axis=1)
        for index in self.indices[different]:
            self.cases[index].acts = True
        alive = {self.cases[i].base for i in self.indices[~different] if self.cases[i].name}
        self.keep(
            [row for row, i in enumerate(self.indices) if not different[row] and (self.cases[i].name or i in alive)]
        )


NAMES_OF_ARGUMENTS = ("sensors", "estimator", "setpoint", "control", "params", "mix", "unmix", "rotors")


def disturbs(name: str, value: Any) -> bool:
    """Return whether a sample field is an error or an outage, which begins later, not the source itself."""
    return name.endswith("+") or (name.endswith("_fresh") and not value)


def apply(sensors: Any, row: int, samples: dict[str, Any], k: int, estimate: Any) -> None:
    """Set sensor fields of a vehicle; flow, range and vision at 25 Hz, by the recorded estimate."""
    position, velocity, q = estimate
    height = max(-float(position[2]), 0.1)
    seen = {
        "range_distance": height,
        "flow_rate": (velocity[1] / height, -velocity[0] / height),
        "flow_gyro": (0.0, 0.0),
        "vision_position": position,
        "vision_velocity": velocity,
        "vision_q": q,
        **dict.fromkeys(("vision_position_variance", "vision_velocity_variance", "vision_yaw_variance"), 1e-6),
    }
    for name, value in (seen | samples).items():
        if name.endswith("+"):
            sensors[name[:-1]][row] += np.asarray(value)
        elif not (name.endswith("_fresh") and value and k % 10):
            sensors[name][row] = value


def tasks() -> list[tuple[float, dict[str, Any]]]:
    """Return setpoints of the tasks that follow each other every half a second."""
    sticks = {"stick_x": -0.9, "stick_y": 0.4, "stick_z": 0.6, "stick_yaw": 0.7}
    slow = {"stick_x": 0.0, "stick_y": 0.0, "stick_z": 0.0, "stick_yaw": 0.0}
    down = sticks | {"stick_z": -0.9}
    return [
        (1.0, {"task": TASK_STICKS, **sticks}), (0.6, {"task": TASK_STICKS, **slow}),
        (0.5, {"task": TASK_STICKS, **down}),
        (0.5, {"task": TASK_ALTITUDE, **sticks}), (0.5, {"task": TASK_MANUAL, **sticks}),
        (0.5, {"task": TASK_ACRO, **sticks}), (0.2, {"task": TASK_MANUAL, **down}),
        (0.4, {"task": TASK_ATTITUDE, "attitude_q": (0.7, 0.6, -0.3, 0.2), "thrust": 0.9}),
        (0.4, {"task": TASK_RATES, "rates": (9.0, -9.0, 9.0), "thrust": 0.02}),
        (0.8, {"task": TASK_TRAJECTORY, "position": (90.0, -90.0, -90.0), "yaw": 3.0}),
        (0.6, {"task": TASK_TRAJECTORY, "position": (NAN, NAN, 90.0), "velocity": (9.0, 0.0, NAN), "yaw": 3.0}),
        (0.4, {"task": TASK_TRAJECTORY, "position": (NAN,) * 3, "velocity": (NAN,) * 3, "yaw_rate": 9.0,
               "acceleration": (50.0, 0.0, -30.0)}),
        (0.6, {"task": TASK_ORBIT, "orbit_centre": (5.0, 5.0), "orbit_radius": 5.0, "orbit_speed": 9.0}),
        (2.0, {"task": TASK_FOLLOW, "target_position": (14.0, 6.0, -1.0), "target_velocity": (0.0, 0.0, 0.0),
               "target_acceleration": (0.0, 0.0, 0.0)}),
        (0.3, {"task": TASK_DESCEND}),
        (1.5, {"task": TASK_STICKS, **slow}),
    ]  # fmt: skip


def setpoint_of(recorded: Any, k: int, down: float, program: list[tuple[int, dict[str, Any]]]) -> Any:
    """Return the recorded setpoint, or that of the task which is due at step ``k``."""
    for start, fields in program:
        if k >= start:
            found = recorded.copy()
            found["task_changed"] = int(k == start)
            found["target_time"] = k * STEP_US * 1e-6 - ARMED
            found["home_z"] = down + 8.0  # so that a follower is at its height
            for name, value in fields.items():
                found[name] = value
            return found
    return recorded


@pytest.fixture(scope="module")
def replayed(flight: Recorder) -> list[Case]:
    replay = Replay(flight, every_case())
    starts, k = [], step_at(TASKS)
    for seconds, fields in tasks():
        starts.append((k, fields))
        k += step_at(seconds)
    assert k < step_at(LANDING)
    program = starts[::-1]
    for k, sample in enumerate(flight.samples):
        setpoint = flight.setpoints[k]
        estimate = [flight.estimates[k][name][0] for name in ("position", "velocity", "q")]
        if step_at(TASKS) <= k < step_at(LANDING):
            setpoint = setpoint_of(setpoint, k, float(estimate[0][2]), program)
        replay.step(k, sample, setpoint, estimate)
        if k % 25 == 0:
            replay.see_obstacles(k)
            replay.compare()
    return replay.cases


def test_every_value_acts(replayed: list[Case]) -> None:
    found: dict[str, list[Case]] = {}
    for case in replayed:
        if case.name:
            found.setdefault(case.name, []).append(case)
    idle = {}
    for name, cases in found.items():
        values = {case.value for case in cases if not case.acts} - SAME.get(name, set())
        if (values and name in CHOICES) or not any(case.acts for case in cases):
            idle[name] = sorted(values)
    assert not idle, "\n".join(f"{name} {idle[name]}" for name in idle)
