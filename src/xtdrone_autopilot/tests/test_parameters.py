"""Parameters: table, types, record."""

from __future__ import annotations

import logging
import math
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from xtdrone_autopilot.parameters import former_parameters
from xtdrone_autopilot.parameters.parameters import (
    FLOAT,
    INT32,
    NAMES,
    PARAMS,
    VOLATILE,
    ParameterError,
    Parameters,
    describe,
)


def test_defaults_are_px4s():
    p = Parameters()
    assert p.get("MPC_XY_P") == pytest.approx(0.95)
    assert p.get("EKF2_NOAID_TOUT") == 5_000_000
    assert isinstance(p.get("EKF2_NOAID_TOUT"), int)
    assert describe("COM_OF_LOSS_T").type == FLOAT
    assert describe("COM_DL_LOSS_T").type == INT32


def test_names_fit_mavlink_and_are_sorted():
    assert list(NAMES) == sorted(set(NAMES))
    assert all(len(name) <= 16 for name in NAMES)


def test_every_default_lies_in_its_range():
    for name in NAMES:
        entry = describe(name)
        assert entry.minimum <= entry.default <= entry.maximum, name
        assert entry.text


def test_airframe_overrides_become_defaults():
    p = Parameters({"MC_ROLL_P": 6.0, "MAV_SYS_ID": 7})
    assert (p.get("MAV_SYS_ID"), p.get("MC_ROLL_P")) == (7, 6.0)
    p.set("MC_ROLL_P", 5.0)
    p.reset()
    assert p.get("MC_ROLL_P") == 6.0


def test_record_follows():
    array = np.zeros(2, PARAMS)
    p = Parameters({"MPC_XY_P": 0.5})
    p.write_to(array[1])
    p.set("MPC_TKO_SPEED", 2.5)
    assert array["mpc_xy_p"].tolist() == [0.0, 0.5]
    assert array["mpc_tko_speed"].tolist() == [0.0, 2.5]


@pytest.mark.parametrize(
    ("name", "value", "kind", "text"),
    [
        ("NO_SUCH", 1.0, None, "NO_SUCH"),
        ("MPC_XY_P", math.nan, None, "finite"),
        ("MPC_XY_P", math.inf, FLOAT, "finite"),
        ("MPC_XY_P", 1e39, None, "too large"),
        ("MPC_XY_P", 1.0, INT32, "MAV_PARAM_TYPE is 9"),
        ("NAV_DLL_ACT", 1.5, None, "integer"),
        ("NAV_DLL_ACT", 2.0**31, None, "integer"),
    ],
)
def test_invalid_values_are_rejected(name, value, kind, text):
    p = Parameters()
    before = p.hash()
    with pytest.raises(ParameterError, match=text):
        p.set(name, value, kind)
    assert p.hash() == before


def test_out_of_range_is_stored_with_a_warning(caplog):
    p = Parameters()
    with caplog.at_level(logging.WARNING):
        assert p.set("MPC_XY_VEL_MAX", 50.0) == 50.0
    assert "MPC_XY_VEL_MAX" in caplog.text


def test_hash_is_px4s_crc():
    p = Parameters()
    p.set("COM_FLIGHT_UUID", 7)  # changes by itself, and is left out
    names = [name for name in NAMES if name not in VOLATILE]
    data = b"".join(n.encode() + struct.pack("<i" if isinstance(p.get(n), int) else "<f", p.get(n)) for n in names)
    # a CRC from register 0 without inversions, by its definition
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    assert p.hash() == crc
    assert p.hash() != zlib.crc32(data)


def test_those_without_an_effect_are_stored_and_listed_like_the_others():
    p = Parameters()
    assert len(NAMES) == 856
    p.set("CAL_MAG0_XCOMP", 0.25, FLOAT)
    p.set("SENS_IMU_MODE", 0, INT32)
    assert (p.get("CAL_MAG0_XCOMP"), p.get("SENS_IMU_MODE")) == (0.25, 0)
    assert not describe("CAL_MAG0_XCOMP").has_effect
    assert describe("MPC_XY_P").has_effect


def test_every_parameter_with_an_effect_is_read():
    """Kernels read a field of the record, all other code a name; a replayed flight tests those of kernels."""
    sources = Path(__file__).parents[2]
    files = [*sources.glob("xtdrone_autopilot/src/**/*.py"), *sources.glob("xtdrone_sim/src/**/*.py")]
    text = "\n".join(file.read_text() for file in files)
    of_kernels = {name for name in NAMES if describe(name).effect == "kernel"}
    fields = set(re.findall(r"\bp\.(\w+)|params\[\"(\w+)\"\]", text))
    read = {field.upper() for found in fields for field in found} & of_kernels
    read |= set(re.findall(r"\"([A-Z0-9_]+)\"", text)) - of_kernels
    made = re.compile(  # names put together: by function, sensor or rotor
        r"COM_FLTMODE[1-6]|RC_MAP_(ROLL|PITCH|YAW|THROTTLE)|RC\d+_(MIN|MAX|TRIM|REV|DZ)|CAL_(ACC|GYRO|MAG)\d_\w+"
        r"|CA_ROTOR\d_(P[XYZ]|A[XYZ]|KM|CT)"
    )
    assert not [name for name in NAMES if describe(name).has_effect and name not in read and not made.fullmatch(name)]


def test_the_page_of_parameters_names_all_that_have_an_effect():
    page = (Path(__file__).parents[3] / "docs" / "parameters.md").read_text(encoding="utf-8")
    effective, rest = page.split("## Stored only")
    stored_only, counted = rest.split("## The most-set")
    for name in NAMES:
        short = re.sub(r"^(CA_ROTOR|CA_R|CA_SV|CAL_[A-Z]+|PWM_MAIN_FUNC|RC|RC_MAP_AUX|RC_MAP_PARAM)\d+", r"\1N", name)
        assert f"`{short}`" in (effective if describe(name).has_effect else stored_only), name
    assert len(re.findall(r"`[A-Z0-9_]+`(?=[^|]*\| \d+ )", counted)) == 40
    assert str(len(NAMES)) in effective
    assert f"{sum(describe(name).has_effect for name in NAMES)} have an effect" in effective


def test_former_names_lead_to_parameters_that_exist():
    assert former_parameters.NAMES & set(NAMES) == {"EKF2_AID_MASK"}
    found = [today for name in former_parameters.NAMES for today in former_parameters.replacements(name)]
    assert len(found) > 50
    assert set(found) <= set(NAMES)
    with pytest.raises(ParameterError, match=r"'COM_OBL_ACT' does not exist: PX4 v1\.14 has COM_OBL_RC_ACT"):
        Parameters({"COM_OBL_ACT": 2})
