"""QGroundControl's parameter files: written and read back, and rejections."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_autopilot.parameters import parameter_file
from xtdrone_autopilot.parameters.parameter_file import LIMITS, REAL32, ParameterFile, ParameterFileError

floats = st.floats(width=32, allow_nan=False, allow_infinity=False).map(lambda value: (value, REAL32))
whole = st.sampled_from(sorted(LIMITS)).flatmap(
    lambda kind: st.integers(*LIMITS[kind]).map(lambda value: (value, kind))
)
values = st.one_of(floats, whole)
names = st.from_regex(r"[A-Z][A-Z0-9_]{0,15}", fullmatch=True)
files = st.builds(
    ParameterFile, st.integers(1, 255), st.dictionaries(names, values, min_size=1), st.sampled_from(["", "PX4 Pro"])
)


@settings(max_examples=100, deadline=None)
@given(files)
def test_written_files_can_be_read(content):
    assert parameter_file.parse(parameter_file.text_of(content)) == content


def test_a_file_of_qgroundcontrol_is_read(tmp_path):
    path = tmp_path / "a.params"
    path.write_text(
        "# Onboard parameters for Vehicle 1\n#\n# Stack: PX4 Pro\n# Vehicle: Multi-Rotor\n# Version: 1.14.3 \n#\n"
        "# Vehicle-Id Component-Id Name Value Type\n"
        "1\t1\tMPC_XY_VEL_MAX\t12.000000000000000000\t9\n1\t1\tSYS_AUTOSTART\t4001\t6\n"
    )
    content = parameter_file.read(path)
    assert content == ParameterFile(1, {"MPC_XY_VEL_MAX": (12.0, 9), "SYS_AUTOSTART": (4001, 6)}, "PX4 Pro")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file has no parameters"),
        ("1 1 A 1 9", "line 1: 1 columns are not allowed, 5 with tabs between"),
        ("0\t1\tA\t1\t9", "vehicle id '0' is not allowed, 1 to 255"),
        ("1\t1\tA B\t1\t9", "name 'A B' is not allowed"),
        ("1\t1\tA\tnan\t9", "A: 'nan' of type '9' is not allowed, a finite number"),
        ("1\t1\tA\t1e60\t9", "a finite number of 32 bits"),
        ("1\t1\tA\t1.5\t6", "a whole number from -2147483648 to 2147483647"),
        ("1\t1\tA\tinf\t6", "a whole number"),
        ("1\t1\tA\tx\t6", "a whole number"),
        ("1\t1\tA\t300\t2", "a whole number from -128 to 127"),
        ("1\t1\tA\t1\t10", "a type of 1, 2, 3, 4, 5, 6 or 9"),
        ("1\t1\tA\t1\tfloat", "a type of"),
    ],
)
def test_an_invalid_row_is_named_and_the_others_are_read(text, message):
    with pytest.raises(ParameterFileError) as error:
        parameter_file.parse(text, "a.params")
    assert message in str(error.value)
    assert str(error.value).startswith("a.params")
    if text:
        found = parameter_file.parse(f"1\t1\tB\t2\t9\n{text}", "a.params")
        assert found.values == {"B": (2.0, REAL32)}
        (skipped,) = found.skipped
        assert skipped.startswith("a.params, line 2: ")
        assert message.removeprefix("line 1: ") in skipped


def test_parameters_of_several_vehicles_are_refused():
    with pytest.raises(ParameterFileError, match="parameters of several vehicles: 1, 2"):
        parameter_file.parse("1\t1\tA\t1\t9\n2\t1\tB\t1\t9", "a.params")


def test_the_autopilots_parameters_are_read_beside_those_of_a_gimbal():
    """QGroundControl writes all components of a vehicle, under the same names too."""
    text = "1\t154\tMNT_MODE\t1\t6\n1\t1\tA\t1\t9\n1\t154\tA\t5\t9\n1\t1\tA\t2\t9\n"
    found = parameter_file.parse(text, "a.params")
    assert found.values == {"A": (2.0, REAL32)}
    assert found.skipped == (
        "a.params, line 4: A occurs a second time, this value counts",
        "a.params: 2 parameters of component 154, not the autopilot",
    )


def test_a_byte_order_mark_and_spaces_are_no_part_of_a_value(tmp_path):
    (tmp_path / "a.params").write_bytes("\ufeff# Stack: PX4 Pro\r\n1\t1\tA\t 2.5 \t9\r\n".encode())
    assert parameter_file.read(tmp_path / "a.params") == ParameterFile(1, {"A": (2.5, REAL32)}, "PX4 Pro")


def test_a_missing_file(tmp_path):
    with pytest.raises(ParameterFileError, match="cannot be read: No such file"):
        parameter_file.read(tmp_path / "none.params")


def test_a_file_without_an_end_is_rejected(tmp_path):
    with (tmp_path / "large.params").open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(ParameterFileError, match=r"cannot be read: it has 1024\.0 MB, at most 4 MB are allowed"):
        parameter_file.read(tmp_path / "large.params")
