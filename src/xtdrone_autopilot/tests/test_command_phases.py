"""MAV_RESULT of commands in every phase of a flight, by PX4 v1.14's source.

``data/px4_results_by_phase.csv`` has a row for each command and a column for each phase: the result, empty for no
acknowledgement, "-" where this autopilot differs: PX4 sets home by a GPS receiver beside its estimator, and checks a
vehicle that is armed by force. From Commander::handle_command,
UserModeIntention::change (any mode while disarmed, else what its requirements allow), navigator_main.cpp and
MavlinkReceiver::handle_message_command_both. A phase on the ground differs from the air in disarming alone: PX4 takes
commands between arming and "Takeoff detected".
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

import pytest
from autopilot_fakes import ORIGIN
from service_fakes import Served

from xtdrone_autopilot import c_casts
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_common import modes

_TABLE = Path(__file__).parent / "data" / "px4_results_by_phase.csv"
NAN = math.nan


def run(served: Served, seconds: float, each: Callable[[], None] = lambda: None) -> None:
    for _ in range(round(seconds * 10)):
        served.autopilot.time_us += 100_000
        each()
        served.commander.update()


def arm(served: Served, mode: modes.Mode = modes.AUTO_LOITER) -> None:
    assert served.commander.request(mode) == 0
    assert served.commander.arm_disarm(True) == 0
    run(served, 0.2)


def fly(served: Served, mode: modes.Mode = modes.AUTO_LOITER) -> None:
    """Take off in ``mode``, or switch to it in the air where it cannot take off."""
    arm(served, modes.AUTO_LOITER if mode.prevents_arming else mode)
    served.autopilot.control[0]["landing"]["landed"] = 0
    run(served, 0.1)
    served.autopilot.place(0, 0.0, 0.0, -1.5)
    run(served, 0.1)
    assert served.commander.mode is mode or served.commander.request(mode) == 0


def fly_mission(served: Served) -> None:
    items = [PlanItem(plan.TAKEOFF, 3, (0.0,) * 3 + (NAN,), *ORIGIN[:2], 10.0)]
    items += [PlanItem(plan.WAYPOINT, 3, (0.0,) * 3 + (NAN,), ORIGIN[0] + 0.0005, ORIGIN[1], 10.0)]
    served.commander.navigator.set_plan(plan.MISSION, items)
    fly(served, modes.AUTO_MISSION)


def fly_offboard(served: Served) -> None:
    def hover() -> None:
        served.commander.offboard.set_trajectory((0.0, 0.0, -2.0), (NAN,) * 3, (NAN,) * 3, 0.0, NAN)

    run(served, 0.5, hover)
    fly(served, modes.AUTO_LOITER)
    run(served, 0.5, hover)
    assert served.commander.request(modes.OFFBOARD) == 0


def lose_the_ground_station(served: Served) -> None:
    for name, value in (("NAV_DLL_ACT", 2), ("COM_DL_LOSS_T", 5), ("COM_FAIL_ACT_T", 0)):
        served.parameters.set(name, value)
    served.commander.gcs_heartbeat()
    fly(served)
    run(served, 5.0)
    assert served.commander.failsafe


def touch_down(served: Served) -> None:
    fly(served, modes.AUTO_LAND)
    served.autopilot.place(0, 0.0, 0.0, 0.0)
    run(served, 0.3)


def lose_the_position(served: Served, *, flying: bool = True) -> None:
    if flying:
        fly(served)
    for field in ("position_valid", "global_valid"):
        served.autopilot.estimator[field] = 0
    run(served, 2.0)
    assert not flying or served.commander.mode is modes.DESCEND


PHASES: dict[str, Callable[[Served], None]] = {
    "disarmed": lambda served: None,
    "blind": lambda served: lose_the_position(served, flying=False),
    "armed": arm,
    "taking_off": lambda served: arm(served, modes.AUTO_TAKEOFF),
    "climbing": lambda served: fly(served, modes.AUTO_TAKEOFF),
    "hold": fly,
    "mission": fly_mission,
    "returning": lambda served: fly(served, modes.AUTO_RTL),
    "landing": lambda served: fly(served, modes.AUTO_LAND),
    "offboard": fly_offboard,
    "failsafe": lose_the_ground_station,
    "landed": touch_down,
    "lost": lose_the_position,
}


def _rows() -> list[dict[str, str]]:
    with _TABLE.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def ask(row: dict[str, str], phase: str, folder: Path, rest: float) -> str:
    """Return the result of a row's command in a phase, with ``rest`` for the parameters that the row leaves out."""
    served = Served(Parameters({"MAV_SYS_ID": 171}, folder / "stored.params"))
    PHASES[phase](served)
    params = [float(value) for value in row["params"].split()]
    result = served.command(int(row["command"]), *params, *[rest] * (7 - len(params)))[0]
    return "" if result is None else str(result)


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("rest", [0.0, NAN])
def test_results_in_every_phase(phase, rest, tmp_path):
    """The unused parameters may be NaN, which MAVSDK sends."""
    found = {(row["command"], row["case"]): ask(row, phase, tmp_path, rest) for row in _rows() if row[phase] != "-"}
    assert found == {(row["command"], row["case"]): row[phase] for row in _rows() if row[phase] != "-"}


# parameters that PX4 casts

CASES = {
    "gyroscope, whatever follows": (241, (1.9, *[NAN] * 6), 0),
    "the first calibration decides": (241, (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0), 0),
    "barometer": (241, (NAN, NAN, 1.0, NAN, NAN, NAN, NAN), 0),
    "magnetometer": (241, (NAN, 1.0, 1.0, NAN, NAN, NAN, NAN), 0),
    "a radio, before the accelerometer": (241, (0.0, 0.0, 0.0, 1.0, 1.0), 3),
    "motor controllers": (241, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), 2),
    "by temperature": (241, (3.0, NAN, NAN, NAN, NAN, NAN, NAN), None),
    "end of a radio's": (241, (0.4, 0.0, 0.0, -0.9, 0.0, 0.0, 0.0), 0),
    "no calibration": (241, (NAN,) * 7, 3),
    "arms": (400, (0.5, NAN), 0),
    "disarms": (400, (NAN,) * 7, 0),
    "a byte that arms": (400, (257.0,), 0),
    "neither": (400, (-0.5,), None),
    "changes the mode": (192, (-1.0, 1.9, *[NAN] * 5), 0),
    "changes no mode": (192, (-1.0, NAN, *[NAN] * 5), 3),
    "all flags": (192, (-1.0, -1.0, *[NAN] * 5), 3),
    "a byte of the base mode": (176, (257.0, 4.0, 3.0), 0),
    "mode 4, 1": (176, (1.9, 4.9, 1.9), 1),
    "a motor": (310, (NAN, NAN, NAN, NAN, 1.4, NAN, NAN), 0),
    "no motor": (310, (0.1, 1.0, NAN, NAN, NAN, NAN, NAN), None),
    "saves": (245, (1.9, *[NAN] * 6), 0),
    "stores nothing": (245, (NAN,) * 7, None),
    "no reboot": (246, (NAN,) * 7, 2),
    "nothing to reboot": (246, (-0.9,), 0),
    "heartbeat": (512, (65536.0, *[NAN] * 6), 0),
    "an interval of all": (510, (NAN,) * 7, 0),
    "no failure": (420, (NAN,) * 7, 3),
}


@pytest.mark.parametrize("case", CASES)
def test_parameters_are_cast_as_in_c(case, tmp_path):
    number, params, result = CASES[case]
    served = Served(Parameters({"MAV_SYS_ID": 171}, tmp_path / "stored.params"))
    assert served.command(number, *params)[0] == result


@pytest.mark.parametrize(
    ("value", "as_int", "byte", "unsigned", "nearest"),
    [
        (1.9, 1, 1, 1, 2),
        (-1.9, -1, 255, 4294967295, -2),
        (-0.5, 0, 0, 0, -1),
        (300.0, 300, 44, 300, 300),
        (3e9, -(1 << 31), 0, 3_000_000_000, 3_000_000_000),
        (2.0**31, -(1 << 31), 0, 1 << 31, 1 << 31),
        (-(2.0**31), -(1 << 31), 0, 1 << 31, -(1 << 31)),
        (1e30, -(1 << 31), 0, 0, -(1 << 63)),
        (math.inf, -(1 << 31), 0, 0, -(1 << 63)),
        (-math.inf, -(1 << 31), 0, 0, -(1 << 63)),
        (NAN, -(1 << 31), 0, 0, -(1 << 63)),
    ],
)
def test_casts_of_c(value, as_int, byte, unsigned, nearest):
    """As CVTTSS2SI gives them on x86-64."""
    found = (c_casts.to_int(value), c_casts.to_byte(value), c_casts.to_unsigned(value), c_casts.nearest(value))
    assert found == (as_int, byte, unsigned, nearest)
