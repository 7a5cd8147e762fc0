"""Parameters that set or limit others: PX4 v1.14, MulticopterPositionControl.cpp, ``parameters_update``."""

from __future__ import annotations

import pytest
from autopilot_fakes import Flight
from pymavlink.dialects.v20 import common as mavlink
from service_fakes import SYSTEM, Served

from xtdrone_autopilot.parameters.dependent_parameters import NAMES, in_order
from xtdrone_autopilot.parameters.parameters import FLOAT, Parameters


def values(parameters, *names):
    return [pytest.approx(parameters.get(name)) for name in names]


@pytest.mark.parametrize(
    ("response", "expected"),
    [
        (0.0, (1.0, 2.0, 80.0, 0.5, 45.0, 0.8, 1.0, 2.0, 1.0)),
        # squared: 0.36 of each range, 0.6 of the way to an unsmoothed yaw
        (0.6, (6.04, 6.68, 213.2, 0.2, 45.0, 5.912, 6.04, 19.28, 9.64)),
        (1.0, (15.0, 15.0, 450.0, 0.0, 70.0, 15.0, 15.0, 50.0, 25.0)),
    ],
)
def test_the_response_sets_the_limits_of_motion(response, expected):
    p = Parameters()
    before = p.hash()
    p.set("SYS_VEHICLE_RESP", -0.1)
    p.set("SYS_VEHICLE_RESP", -0.4)
    assert p.hash() == before
    p.set("SYS_VEHICLE_RESP", response)
    names = (
        "MPC_ACC_HOR", "MPC_ACC_HOR_MAX", "MPC_MAN_Y_MAX", "MPC_MAN_Y_TAU", "MPC_TILTMAX_AIR", "MPC_ACC_DOWN_MAX",
        "MPC_ACC_UP_MAX", "MPC_JERK_MAX", "MPC_JERK_AUTO",
    )  # fmt: skip
    assert list(expected) == values(p, *names)
    p.set("MPC_JERK_MAX", 3.0)
    assert expected[7] == values(p, "MPC_JERK_MAX")[0], "the input overwrites it for as long as it is set"


def test_one_speed_for_all_modes():
    p = Parameters()
    p.set("MPC_VEL_MAN_BACK", 2.0)
    p.set("MPC_XY_VEL_ALL", 7.0)
    names = ("MPC_VEL_MANUAL", "MPC_XY_CRUISE", "MPC_XY_VEL_MAX", "MPC_VEL_MAN_BACK", "MPC_VEL_MAN_SIDE")
    assert values(p, *names) == [7.0, 7.0, 7.0, -1.0, -1.0]
    p.set("MPC_Z_VEL_ALL", 4.0)
    names = ("MPC_Z_V_AUTO_UP", "MPC_Z_VEL_MAX_UP", "MPC_Z_V_AUTO_DN", "MPC_Z_VEL_MAX_DN")
    assert values(p, *names) == [4.0, 4.0, 3.0, 3.0]
    assert values(p, "MPC_TKO_SPEED", "MPC_LAND_SPEED") == [2.4, 2.0]


@pytest.mark.parametrize(
    ("name", "value", "limited", "text"),
    [
        ("MPC_XY_CRUISE", 13.0, 12.0, "Cruise speed has been constrained by max speed"),
        ("MPC_VEL_MANUAL", 13.0, 12.0, "Manual speed has been constrained by max speed"),
        ("MPC_VEL_MAN_BACK", 11.0, 10.0, "Manual backward speed has been constrained by forward speed"),
        ("MPC_VEL_MAN_SIDE", 11.0, 10.0, "Manual sideways speed has been constrained by forward speed"),
        ("MPC_Z_V_AUTO_UP", 4.0, 3.0, "Ascent speed has been constrained by max speed"),
        ("MPC_Z_V_AUTO_DN", 2.0, 1.5, "Descent speed has been constrained by max speed"),
        ("MPC_TILTMAX_AIR", 90.0, 89.0, "Tilt constrained to safe value"),
        ("MPC_TILTMAX_LND", 50.0, 45.0, "Land tilt has been constrained by max tilt"),
        ("MPC_THR_HOVER", 0.05, 0.12, "Hover thrust has been constrained by min/max"),
        ("MPC_POS_MODE", 2, 4, None),
    ],
)
def test_values_beyond_their_maximum_are_lowered_with_a_text(name, value, limited, text):
    flight = Flight()
    flight.texts()
    flight.parameters.set(name, value)
    assert values(flight.parameters, name) == [limited]
    assert [entry.strip() for entry in flight.texts()] == ([text] if text else [])


def test_clients_are_told_of_all_values_that_have_changed():
    served = Served()
    answers = served.ask(mavlink.MAVLink_param_set_message(SYSTEM, 1, b"MPC_XY_VEL_ALL", 15.0, FLOAT))
    found = [(m.param_id, m.param_value) for m in answers]
    assert found[0] == ("MPC_XY_VEL_ALL", 15.0)
    assert sorted(found[1:]) == [(name, 15.0) for name in ("MPC_VEL_MANUAL", "MPC_XY_CRUISE", "MPC_XY_VEL_MAX")]
    assert [m.param_id for _, m in served.other.sent] == [name for name, _ in found]
    answers = served.ask(mavlink.MAVLink_param_set_message(SYSTEM, 1, b"MPC_XY_CRUISE", 3.0, FLOAT))
    assert [(m.param_id, m.param_value) for m in answers] == [("MPC_XY_CRUISE", 3.0), ("MPC_XY_CRUISE", 15.0)]


def test_a_file_is_adjusted_as_a_whole(tmp_path):
    file = tmp_path / "iris_0.params"
    file.write_text("1\t1\tMPC_XY_CRUISE\t15.0\t9\n1\t1\tMPC_XY_VEL_MAX\t18.0\t9\n")
    assert values(Parameters(file=file), "MPC_XY_CRUISE", "MPC_XY_VEL_MAX") == [15.0, 18.0]
    assert values(Parameters({"MPC_XY_VEL_MAX": 1.5}), "MPC_XY_CRUISE", "MPC_VEL_MANUAL") == [1.5, 1.5]
    p = Parameters({"MPC_XY_VEL_ALL": 5.0}, file)
    assert p.take_adjusted() == []
    p.load()
    assert p.take_adjusted() == [], "no client has changed one"


def test_a_files_parameters_can_be_set_one_by_one():
    wanted = {"MPC_XY_CRUISE": 15.0, "MPC_XY_VEL_MAX": 18.0, "MPC_VEL_MAN_SIDE": 14.0, "MPC_VEL_MANUAL": 16.0,
              "MPC_XY_VEL_ALL": -1.0, "MPC_XY_P": 1.0, "MPC_Z_V_AUTO_UP": 5.0, "MPC_Z_VEL_MAX_UP": 6.0}  # fmt: skip
    p = Parameters({"MPC_XY_VEL_ALL": 5.0})
    for name in in_order(wanted):
        p.set(name, wanted[name])
    assert values(p, *wanted) == list(wanted.values())


def test_every_name_exists():
    assert set(Parameters()._values) >= NAMES
