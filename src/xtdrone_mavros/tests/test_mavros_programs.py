"""mavsys and related programs: files, tables and command lines; tests/test_stack.py runs them on a MAVROS."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mavros_msgs.msg import Waypoint

from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.plans import waypoint_file
from xtdrone_autopilot.plans.waypoint_file import Row, WaypointFileError
from xtdrone_mavros.programs import mavcmd, mavparam, mavsafety, mavsys, mavwp, parameter_formats
from xtdrone_mavros.programs.parameter_formats import MAVPROXY, MISSION_PLANNER, QGC, FormatError

# ---- parameter files

_names = st.from_regex(r"[A-Z][A-Z0-9_]{0,15}", fullmatch=True)
_floats = st.floats(width=32, allow_nan=False, allow_infinity=False)
_integers = st.integers(-(1 << 31), (1 << 31) - 1)
_parameters = st.dictionaries(_names, st.one_of(_integers, _floats), min_size=1, max_size=8)


@given(_parameters, st.sampled_from([QGC, MISSION_PLANNER, MAVPROXY]))
def test_parameters_are_read_as_they_were_written(values, kind):
    text = parameter_formats.write(values, kind, 7)
    for given_kind in (kind, ""):
        found = parameter_formats.read(text, "a.txt", given_kind)
        assert found == values
        assert {name: type(value) for name, value in found.items()} == {n: type(v) for n, v in values.items()}
    for line in text.splitlines():  # MAVROS reads a value with a point as a float, any other as an integer
        if not line.startswith("#"):
            name, value = line.split("\t")[2:4] if kind == QGC else line.replace(",", " ").split()
            assert ("." in value) == isinstance(values[name], float)


def test_a_row_that_cannot_be_set_is_named_and_the_others_are_read():
    noted = []
    text = "# Stack: PX4 Pro\n1\t1\tA\t1\t6\n1\t1\tB\tnan\t9\n1\t154\tMNT_MODE\t1\t6\n"
    assert parameter_formats.read(text, "a.txt", QGC, noted.append) == {"A": 1}
    assert noted == [
        "a.txt, line 3: B: 'nan' of type '9' is not allowed, a finite number of 32 bits",
        "a.txt: 1 parameters of component 154, not the autopilot",
    ]


def test_parameter_files_look_as_mavros_writes_them():
    values = {"NAV_RCL_ACT": 2, "MPC_XY_P": 0.949999988079071, "MPC_Z_P": 1.0}
    comment = "#NOTE: saved by mavparam\r\n"
    assert parameter_formats.write(values, MISSION_PLANNER) == (
        comment + "MPC_XY_P,0.95\r\nMPC_Z_P,1.0\r\nNAV_RCL_ACT,2\r\n"
    )
    assert parameter_formats.write(values, MAVPROXY) == comment + "MPC_XY_P 0.95\r\nMPC_Z_P 1.0\r\nNAV_RCL_ACT 2\r\n"
    rows = [line for line in parameter_formats.write(values, QGC, 2).splitlines() if not line.startswith("#")]
    assert rows == ["2\t1\tMPC_XY_P\t0.95\t9", "2\t1\tMPC_Z_P\t1.0\t9", "2\t1\tNAV_RCL_ACT\t2\t6"]
    assert [parameter_formats.format_of(name) for name in ("a.txt", "a.parm", "-")] == [
        QGC,
        MISSION_PLANNER,
        MISSION_PLANNER,
    ]


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("", "", "a.parm: the file has no parameters"),
        ("A,1,2", "", "a.parm, line 1: 3 columns are not allowed, a name and a value"),
        ("#\nA-B,1", "", "line 2: name 'A-B' is not allowed"),
        ("A,1\nA,2", "", "line 2: duplicate parameter A"),
        ("A nan", "", "line 1: A: 'nan' is not allowed, a finite number of 32 bits"),
        ("A 1e60", "", "A: '1e60' is not allowed, a finite number of 32 bits"),
        ("A 4000000000", "", "A: '4000000000' is not allowed, a whole number from -2147483648 to 2147483647"),
        ("A " + "9" * 5000, "", "is not allowed, a finite number"),
        ("A,1", QGC, "line 1: 1 columns are not allowed, 5 with tabs between"),
    ],
)
def test_invalid_parameter_files(text, kind, message):
    with pytest.raises(FormatError) as error:
        parameter_formats.read(text, "a.parm", kind)
    assert message in str(error.value)


# ---- mission files

_numbers = st.floats(width=32, allow_infinity=False)
_rows = st.builds(
    Row,
    st.builds(
        PlanItem,
        st.integers(0, 0xFFFF),
        st.integers(0, 0xFF),
        st.tuples(_numbers, _numbers, _numbers, _numbers),
        st.floats(-180.0, 180.0),
        st.floats(-180.0, 180.0),
        _numbers,
        st.booleans(),
    ),
    st.booleans(),
)


@settings(max_examples=50)
@given(st.lists(_rows, max_size=4))
def test_a_mission_is_read_as_it_was_written_and_sent(rows):
    found = waypoint_file.read(waypoint_file.write(rows), "a.waypoints")
    assert repr(found) == repr(rows)  # NaN is NaN here
    assert repr([mavwp.to_row(mavwp.to_waypoint(row)) for row in rows]) == repr(rows)


HOME_AND_TAKEOFF = """QGC WPL 110
# of a ground station
0\t1\t0\t16\t0\t0\t0\t0\t47.3977415\t8.5455938\t488.1\t1
1\t0\t3\t22\t15.0\t0\t0\tnan\t47.4\t8.5\t10\t0
"""


def test_a_mission_of_a_ground_station():
    home, takeoff = waypoint_file.read(HOME_AND_TAKEOFF, "a.waypoints")
    assert home == Row(PlanItem(16, 0, (0.0, 0.0, 0.0, 0.0), 47.3977415, 8.5455938, 488.1, True), True)
    assert (takeoff.item.command, takeoff.item.frame, takeoff.item.z) == (22, 3, 10.0)
    assert math.isnan(takeoff.item.params[3])
    assert (takeoff.item.autocontinue, takeoff.current) == (False, False)


ITEM = "0 1 3 16 0 0 0 0 47 8 10 1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "a.wp: is empty, its first line must be QGC WPL 110 or QGC WPL 120"),
        ("{}", "a.wp, line 1: '{}' is not allowed, QGC WPL 110 or QGC WPL 120"),
        ("QGC WPL 100", "'QGC WPL 100' is not allowed"),
        ("QGC WPL 110\n0 1", "line 2: 2 columns are not allowed, 12"),
        ("QGC WPL 110\n" + ITEM.replace("3", "256", 1), "line 2: frame '256' is not allowed, 0 to 255"),
        ("QGC WPL 110\n" + ITEM.replace("16", "-1"), "command '-1' is not allowed, 0 to 65535"),
        ("QGC WPL 110\n" + ITEM.replace("47", "north"), "x 'north' is not allowed, a number of 32 bits or nan"),
        ("QGC WPL 110\n" + ITEM.replace("10", "inf"), "z 'inf' is not allowed"),
        ("QGC WPL 110\n" + ITEM[:-1] + "2", "autocontinue '2' is not allowed, 0 to 1"),
        ("QGC WPL 110\n" + "9" * 5000 + ITEM[1:], "index"),
    ],
)
def test_invalid_mission_files(text, message):
    with pytest.raises(WaypointFileError) as error:
        waypoint_file.read(text, "a.wp")
    assert message in str(error.value)


def test_a_mission_is_shown_as_a_table():
    takeoff = PlanItem(22, Waypoint.FRAME_GLOBAL_REL_ALT, (15.0, 0.0, 0.0, 0.0), 47.5, 8.5, 10.0)
    jump = PlanItem(177, Waypoint.FRAME_MISSION, (0.0, 2.0, 0.0, 0.0), 0.0, 0.0, 0.0, False)
    unknown = PlanItem(65535, 99, (0.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0)
    lines = mavwp.table([Row(takeoff, True), Row(jump), Row(unknown)]).splitlines()
    assert len({len(line) for line in lines}) == 1
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells[1] == ["#", "Curr", "Auto", "Frame", "Command", "P1", "P2", "P3", "P4", "X Lat", "Y Long", "Z Alt"]
    assert cells[3][:6] == ["0", "Yes", "Yes", "GRA (3)", "TAKEOFF (22)", "15.0"]
    assert cells[4][:5] == ["1", "No", "No", "MIS (2)", "DO-JUMP (177)"]
    assert cells[5][3:5] == ["UNK (99)", "UNK (65535)"]


# ---- command lines


@pytest.mark.parametrize(
    ("program", "line"),
    [
        (mavsys, "-n iris_0/mavros --wait mode -c OFFBOARD"),
        (mavsys, "-v mode -b 0"),
        (mavsys, "rate --all 10 --raw-sensors 50 --ext-status 1 --rc-channels 1 --raw-controller 1"),
        (mavsys, "rate --position 30 --extra1 1 --extra2 1 --extra3 0 --stream-id 6 10"),
        (mavsys, "message_interval --id 32 --rate -1"),
        (mavcmd, "long -c 176 1 4 -3 0 0 0 nan"),
        (mavcmd, "long -b 400 1 0 0 0 0 0 0"),
        (mavcmd, "int -c -a -f 6 192 -1 0 0 nan 473977418 -85455938 500"),
        (mavcmd, "sethome -c 0 0 0"),
        (mavcmd, "takeoff 0 -1.5 47.4 8.5 500"),
        (mavcmd, "land 0 47.4 8.5 500"),
        (mavcmd, "takeoffcur -a 0 0 500"),
        (mavcmd, "landcur 0 488"),
        (mavcmd, "trigger_control -d -c 100"),
        (mavparam, "load -mp a.parm"),
        (mavparam, "load -mavpx a.parm"),
        (mavparam, "dump -f -qgc a.txt"),
        (mavparam, "get MPC_XY_P"),
        (mavparam, "set MPC_XY_P -0.5"),
        (mavwp, "show -f -p"),
        (mavwp, "load -p -s 1 -e 2 a.waypoints"),
        (mavwp, "pull"),
        (mavwp, "dump -"),
        (mavwp, "clear"),
        (mavwp, "setcur 2"),
        (mavwp, "set 2"),
        (mavsafety, "-v arm"),
        (mavsafety, "disarm"),
        (mavsafety, "kill"),
        (mavsafety, "safetyarea -p1 -10 -10 0 -p2 10 10 20"),
    ],
)
def test_command_lines_of_mavros_are_accepted(program, line):
    assert callable(program.parser().parse_args(line.split()).run)


@pytest.mark.parametrize(
    ("program", "line"),
    [(mavsys, ""), (mavsys, "mode"), (mavsys, "mode -b 1 -c LAND"), (mavparam, "load -mp -qgc a"), (mavsafety, "fly")],
)
def test_wrong_command_lines_end_with_status_2(program, line):
    with pytest.raises(SystemExit) as error:
        program.parser().parse_args(line.split())
    assert error.value.code == 2
