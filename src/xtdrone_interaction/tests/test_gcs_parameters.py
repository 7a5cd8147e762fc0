"""Parameters by the ground station: encodings, and real MAVLink servers while time is paused."""

from __future__ import annotations

import struct

import pytest
from gcs_field import FIRST, Field, LossyLine
from gcs_script import beat, talk, told
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.parameters import parameter_file
from xtdrone_autopilot.parameters.parameter_file import LIMITS, REAL32, ParameterFile
from xtdrone_autopilot.parameters.parameters import NAMES
from xtdrone_interaction.gcs import GcsError, Peer, station
from xtdrone_interaction.gcs.exchanges import parameters
from xtdrone_interaction.gcs.exchanges.exchange import RefusalError
from xtdrone_interaction.gcs_commands.gcs_cli import main

PATIENCE = 120.0  # s; only a broken run takes so long
INT32 = 6

floats = st.floats(width=32, allow_nan=False, allow_infinity=False).map(lambda value: (value, REAL32))
whole = st.sampled_from(sorted(LIMITS)).flatmap(
    lambda kind: st.integers(*LIMITS[kind]).map(lambda value: (value, kind))
)
values = st.one_of(floats, whole)


# ---- encodings


@settings(max_examples=100, deadline=None)
@given(values)
def test_a_value_is_the_same_on_both_ends(value):
    number, kind = value
    if kind != REAL32 and struct.unpack("<I", struct.pack("<q", number)[:4])[0] & 0x7F800000 == 0x7F800000:
        number = 5  # a float may change the bits of a NaN in transit
    sent = parameters.encode((number, kind))
    message = mavlink.MAVLink_param_value_message(b"A", sent, kind, 1, 0)
    assert parameters.decode(told(message)) == (number, kind)


def test_check_lists_what_a_file_sets_without_effect(tmp_path, capsys):
    rows = {"MPC_XY_P": (0.8, REAL32), "CAL_MAG0_XCOMP": (0.25, REAL32), "CAL_MAG0_YCOMP": (0.0, REAL32)}
    rows |= {"SENS_IMU_MODE": (0, INT32), "COM_OBL_ACT": (2, INT32)}
    parameter_file.write(tmp_path / "a.params", ParameterFile(1, rows, parameters.STACK))
    assert main(["check", str(tmp_path / "a.params")]) == 0
    printed = capsys.readouterr().out
    assert "5 parameters, 2 other than PX4's default are stored without effect here" in printed
    assert "CAL_MAG0_XCOMP    0.25, PX4's default 0" in printed
    assert "SENS_IMU_MODE     0, PX4's default 1" in printed
    assert "COM_OBL_ACT       does not exist: PX4 v1.14 has COM_OBL_RC_ACT" in printed
    assert "MPC_XY_P" not in printed
    assert "CAL_MAG0_YCOMP" not in printed
    (tmp_path / "bad.params").write_text("1 1 MPC_XY_P\n")
    assert main(["check", str(tmp_path / "bad.params"), str(tmp_path / "a.params")]) == 2
    captured = capsys.readouterr()
    assert "bad.params" in captured.err
    assert "a.params: 5 parameters" in captured.out


# ---- a scripted vehicle, and the result of a load


def _text(name):
    return name.decode() if isinstance(name, bytes) else name


class Store:
    """A vehicle with parameters, some of them read-only."""

    def __init__(self, values, fixed=()):
        self.values = dict(values)
        self._fixed = fixed
        self.sets = 0

    def __call__(self, message):
        name = _text(getattr(message, "param_id", ""))
        if message.msgname == "PARAM_REQUEST_LIST":
            return [self._told(each) for each in list(self.values)[:-1]]  # the last is lost
        if message.msgname == "PARAM_REQUEST_READ" and message.param_index >= 0:
            name = list(self.values)[message.param_index]
        if name not in self.values:
            return []
        if message.msgname == "PARAM_SET":
            self.sets += 1
            if name not in self._fixed:
                self.values[name] = parameters.decode(told(message))
        return [self._told(name)]

    def _told(self, name):
        value, kind = self.values[name]
        index = list(self.values).index(name)
        sent = parameters.encode((value, kind))
        return told(mavlink.MAVLink_param_value_message(name.encode(), sent, kind, len(self.values), index))


def some_vehicle():
    return Store({"MAV_SYS_ID": (7, INT32), "WPNAV_SPEED": (500.0, 9), "RTL_ALT": (1500, INT32)})


def test_a_vehicle_is_read_and_set():
    vehicle = some_vehicle()
    content = talk(parameters.save(beat()), vehicle)
    assert content == ParameterFile(7, vehicle.values, "PX4 Pro")
    talk(parameters.change(beat(), "RTL_ALT", 2000), vehicle)
    assert vehicle.values["RTL_ALT"] == (2000, INT32)


def test_rejected_values_are_reported():
    vehicle = Store({"A": (1, INT32), "B": (1, INT32)}, fixed="A")
    with pytest.raises(RefusalError, match="A: 5 is rejected, 1 is kept"):
        talk(parameters.change(beat(), "A", 5), vehicle)
    with pytest.raises(RefusalError, match=r"A: 1\.5 is not allowed, a whole number"):
        talk(parameters.change(beat(), "A", 1.5), vehicle)
    with pytest.raises(RefusalError, match="the vehicle sends no value of NO_SUCH"):
        talk(parameters.change(beat(), "NO_SUCH", 1), vehicle)
    content = ParameterFile(7, {"A": (2, INT32), "B": (2, INT32)})
    with pytest.raises(RefusalError, match="1 of 2 parameters are set; A: 2 is rejected, 1 is kept"):
        talk(parameters.load(beat(), content, False), vehicle)
    assert vehicle.values["B"] == (2, INT32)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ParameterFile(7, {"RTL_ALT": (1, INT32)}, "ArduPilot"), "the file is of ArduPilot, this is PX4 Pro"),
        (ParameterFile(3, {"RTL_ALT": (1, INT32)}), "the file is of vehicle 3, this is system 7"),
        (ParameterFile(7, {"MPC_Z": (1.0, 9)}), "the vehicle has none of the file's parameters, for example MPC_Z"),
    ],
)
def test_a_file_of_another_vehicle_sets_nothing(content, message):
    vehicle = some_vehicle()
    with pytest.raises(RefusalError, match=message):
        talk(parameters.load(beat(), content, False), vehicle)
    assert vehicle.sets == 0


def test_another_vehicles_file_does_not_make_it_that_vehicle():
    vehicle = some_vehicle()
    content = ParameterFile(3, {"MAV_SYS_ID": (3, INT32), "RTL_ALT": (1, INT32)})
    loaded = talk(parameters.load(beat(), content, True), vehicle)
    assert loaded == parameters.Loaded({"RTL_ALT": ((1500, INT32), (1, INT32))})
    assert vehicle.values["MAV_SYS_ID"] == (7, INT32)


def test_parameters_that_a_vehicle_does_not_have_are_listed_and_the_others_set():
    vehicle = some_vehicle()
    values = {"RTL_ALT": (1, INT32), "MPC_XY_VEL_P": (1.0, 9), "NO_SUCH": (1.0, 9), "WPNAV_SPEED": (3, INT32)}
    loaded = talk(parameters.load(beat(), ParameterFile(7, values, skipped=("a.params, line 2: x",)), False), vehicle)
    assert loaded.changed == {"RTL_ALT": ((1500, INT32), (1, INT32))}
    assert vehicle.values["RTL_ALT"] == (1, INT32)
    assert loaded.skipped == (
        "a.params, line 2: x",
        "MPC_XY_VEL_P does not exist: PX4 v1.14 has MPC_XY_VEL_P_ACC in its place",
        "NO_SUCH does not exist",
        "WPNAV_SPEED is of type 6 in the file, of type 9 in the vehicle",
    )


# ---- real MAVLink servers


@pytest.fixture(scope="module")
def field():
    field = Field()
    yield field
    field.close()


def vehicles(field, count=3):
    return ["--vehicle", *[str(vehicle.id) for vehicle in field.vehicles[:count]]]


def test_parameters_are_shown_and_set(field, capsys):
    assert main(["params", "set", "MIS_TAKEOFF_ALT", "6.5", *vehicles(field, 2)]) == 0
    assert main(["params", "set", "NAV_DLL_ACT", "2", *vehicles(field, 1)]) == 0
    capsys.readouterr()
    assert main(["params", "get", "MIS_TAKEOFF_ALT", "NAV_DLL_ACT", *vehicles(field)]) == 0
    assert [line.split()[1:] for line in capsys.readouterr().out.splitlines()] == [
        ["MIS_TAKEOFF_ALT", "6.5"], ["NAV_DLL_ACT", "2"],
        ["MIS_TAKEOFF_ALT", "6.5"], ["NAV_DLL_ACT", "0"],
        ["MIS_TAKEOFF_ALT", "2.5"], ["NAV_DLL_ACT", "0"],
    ]  # fmt: skip
    assert main(["params", "get", "MPC_XY_*", *vehicles(field, 1)]) == 0
    assert "MPC_XY_VEL_MAX" in capsys.readouterr().out


def test_parameters_are_saved_compared_and_loaded(field, tmp_path, capsys):
    one = vehicles(field, 1)
    path = tmp_path / "mine.params"
    assert main(["params", "save", str(path), *one]) == 0
    content = parameter_file.read(path)
    assert set(content.values) == set(NAMES)
    assert (content.system, content.stack) == (FIRST + 1, "PX4 Pro")
    assert main(["params", "diff", str(path), *one]) == 0
    old = field.commanders[0].parameters.get("MPC_LAND_ALT1")
    field.commanders[0].parameters.set("MPC_LAND_ALT1", 1.25)
    capsys.readouterr()
    assert main(["params", "diff", str(path), *one]) == 1
    assert capsys.readouterr().out.split() == [f"vehicle_{FIRST}", "MPC_LAND_ALT1", "1.25", "file:", f"{old:g}"]
    assert main(["params", "load", str(path), *one]) == 0
    assert f"MPC_LAND_ALT1     {old:g}, was 1.25" in capsys.readouterr().out
    assert field.commanders[0].parameters.get("MPC_LAND_ALT1") == old
    assert main(["params", "load", str(path), *vehicles(field, 2)]) == 1  # the second vehicle differs
    assert f"the file is of vehicle {FIRST + 1}, this is system {FIRST + 2}" in capsys.readouterr().err
    assert main(["params", "save", str(path), *vehicles(field, 2)]) == 2
    assert "a folder is needed for 2 vehicles" in capsys.readouterr().err
    assert main(["params", "save", str(tmp_path), *vehicles(field, 2)]) == 0
    assert main(["params", "load", str(tmp_path), *vehicles(field, 2)]) == 0


def test_what_a_vehicle_does_not_have_is_listed_and_the_rest_is_set(field, tmp_path, capsys):
    one = vehicles(field, 1)
    rows = ("MPC_XY_VEL_P\t0.09\t9", "MPC_TILTMAX_AIR\t41.5\t9", "NO_SUCH\t1\t6", "MPC_XY_P\tnan\t9")
    (tmp_path / "mine.params").write_text("".join(f"{FIRST + 1}\t1\t{row}\n" for row in rows))
    assert main(["params", "load", str(tmp_path / "mine.params"), *one]) == 0
    said = capsys.readouterr()
    assert "1 parameters set, 3 rows of the file skipped, the rest is the same" in said.out
    assert "skipped: MPC_XY_VEL_P does not exist: PX4 v1.14 has MPC_XY_VEL_P_ACC in its place" in said.err
    assert "skipped: NO_SUCH does not exist\n" in said.err
    assert "mine.params, line 4: MPC_XY_P: 'nan' of type '9' is not allowed" in said.err
    assert field.commanders[0].parameters.get("MPC_TILTMAX_AIR") == 41.5


def test_one_bad_file_does_not_keep_the_other_vehicles_from_being_set(field, tmp_path, capsys):
    first, second = f"vehicle_{FIRST}", f"vehicle_{FIRST + 1}"
    (tmp_path / f"{first}.params").write_text("nothing")
    (tmp_path / f"{second}.params").write_text(f"{FIRST + 2}\t1\tMPC_TILTMAX_AIR\t42.5\t9\n")
    for verb, status in (("diff", 1), ("load", 1)):
        assert main(["params", verb, str(tmp_path), *vehicles(field, 2)]) == status
        said = capsys.readouterr()
        assert "MPC_TILTMAX_AIR" in said.out
        assert f"{first}.params: the file has no parameters" in said.err
    assert field.commanders[1].parameters.get("MPC_TILTMAX_AIR") == 42.5


def test_over_a_line_that_loses_a_third(field):
    line = LossyLine(field.ports, 0.3, 4)
    try:
        peers = [Peer(name, 0, "127.0.0.1", port) for name, port in line.ports.items()]
        limits = {"timeout": 0.05, "patience": PATIENCE, "on_abort": station.no_abort_messages}
        for found in station.run(dict.fromkeys(peers, parameters.fetch_all), **limits).values():
            assert not isinstance(found, GcsError), found
            assert set(found) == set(NAMES)
        new = {name: (value, 9) for value, name in enumerate(("MPC_XY_P", "MPC_Z_P", "MPC_TILTMAX_AIR"), 1)}
        results = station.run(dict.fromkeys(peers, lambda beat: parameters.store(beat, new)), **limits)
        assert list(results.values()) == [{}] * 3
        assert [commander.parameters.get("MPC_Z_P") for commander in field.commanders] == [2.0] * 3
    finally:
        line.close()
