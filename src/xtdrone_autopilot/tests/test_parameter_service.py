"""The parameter protocol after PX4, and parameter files."""

from __future__ import annotations

import logging
import struct

import pytest
from pymavlink.dialects.v20 import common as mavlink
from service_fakes import SYSTEM, Served

from xtdrone_autopilot.mavlink.wire import dialect
from xtdrone_autopilot.parameters.parameters import FLOAT, INT32, NAMES, Parameters, describe


@pytest.fixture
def served():
    return Served()


def request_list(system=SYSTEM):
    return mavlink.MAVLink_param_request_list_message(system, 1)


def values(found):
    """Return the PARAM_VALUE entries of the found messages."""
    return [entry for entry in found if entry[-2] == "PARAM_VALUE"]


def write(name, value, kind=FLOAT, system=SYSTEM):
    return mavlink.MAVLink_param_set_message(system, 1, name.encode(), value, kind)


def test_list_begins_and_ends_with_the_hash_and_is_sent_in_bursts(served):
    first = served.ask(request_list())
    assert [m.param_id for m in first] == ["_HASH_CHECK"]
    found = values(served.run(1.0))
    assert [m.param_id for _, _, m in found] == [*NAMES, "_HASH_CHECK"]
    assert [m.param_index for _, _, m in found] == [*range(len(NAMES)), 0xFFFF]
    per_step = [sum(1 for t, _, _ in found if t == when) for when in {t for t, _, _ in found}]
    assert max(per_step) <= 21, "a burst must not overrun a client's socket"
    assert found[-1][0] <= served.autopilot.time_us - 1_000_000 + len(NAMES) * 1000 + 40_000


def test_a_known_hash_stops_the_list(served):
    served.ask(request_list())
    served.run(0.024)
    served.ask(write("_HASH_CHECK", 0.0, 5))
    assert values(served.run(1.0)) == []


def test_a_second_request_begins_anew_without_the_hash(served):
    served.ask(request_list())
    served.run(0.044)
    assert served.ask(request_list()) == []
    assert values(served.run(1.0))[0][2].param_id == NAMES[0]


def test_lists_of_two_clients_do_not_mix_and_share_the_rate(served):
    served.ask(request_list())
    served.run(0.024)
    served.ask(request_list(), served.other)
    served.other.sent.clear()
    found = values(served.run(2.0))
    assert len(found) == len(NAMES) - 20 + 1, "the hash ends it"
    assert [t - found[0][0] for t, _, _ in found][20:60:20] == [40_000, 80_000]
    assert [m.param_id for _, m in values(served.other.sent)] == [*NAMES, "_HASH_CHECK"]


def test_the_list_of_a_participant_does_not_wait_for_others(served):
    served.ask(request_list(), served.other)
    served.ask(request_list(), participant=True)
    assert len(values(served.run(len(NAMES) * 0.001 + 0.02))) == len(NAMES) + 1


def test_a_value_has_the_bytes_of_pymavlinks_message(served):
    served.run(0.004)
    for name, kind in (("MPC_XY_P", FLOAT), ("MIS_DIST_1WP", FLOAT), ("NAV_DLL_ACT", INT32)):
        (m,) = served.ask(mavlink.MAVLink_param_request_read_message(SYSTEM, 1, name.encode(), -1))
        bits = struct.pack("<i", int(served.parameters.get(name)))
        value = served.parameters.get(name) if kind == FLOAT else struct.unpack("<f", bits)[0]
        again = mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(NAMES), m.param_index)
        assert served.link.frames[-1] == bytes(again.pack(mavlink.MAVLink(None, srcSystem=SYSTEM, srcComponent=1)))


def test_messages_to_all_systems_are_left_alone_as_px4_does(served):
    assert not served.ask(request_list(0))
    assert not served.ask(mavlink.MAVLink_param_request_read_message(0, 0, b"MPC_XY_P", -1))
    assert not served.ask(write("MPC_XY_P", 1.0, system=0))
    assert served.parameters.get("MPC_XY_P") == 0.95
    assert not values(served.run(1.0))


def test_all_clients_receive_a_written_value(served):
    for value in (1.0, 50.0):  # out of range values are accepted too
        answers = served.ask(write("MPC_XY_P", value))
        assert [(m.param_id, m.param_value) for m in answers] == [("MPC_XY_P", value)]
        assert served.other.sent[-1][1].param_value == value


@pytest.mark.parametrize(
    ("name", "value", "kind"),
    [("NO_SUCH", 1.0, FLOAT), ("MPC_XY_P", 1.0, INT32), ("NAV_DLL_ACT", 1.0, FLOAT), ("MPC_XY_P", float("nan"), FLOAT)],
)
def test_unwritable_messages_are_not_answered(served, name, value, kind):
    before = served.parameters.hash()
    assert not served.ask(write(name, value, kind))
    assert not served.other.sent
    assert served.parameters.hash() == before
    assert served.link.warnings


def test_a_client_is_told_once_of_a_parameter_without_effect(served):
    for value in (1.0, 2.0):
        served.ask(write("CAL_MAG0_XCOMP", value))
        served.ask(write("MPC_XY_P", value))
        served.run(1.5)
    assert [text for _, text in served.link.texts] == ["CAL_MAG0_XCOMP stored, no effect here"]
    assert not served.other.texts
    served.ask(write("CAL_MAG0_XCOMP", 3.0), served.other)
    served.run(1.5)
    assert [text for _, text in served.other.texts] == ["CAL_MAG0_XCOMP stored, no effect here"]


def test_a_file_that_is_loaded_makes_one_text(served):
    names = [name for name in NAMES if not describe(name).has_effect and describe(name).type == FLOAT][:37]
    for name in names:
        served.ask(write(name, 0.5))
        served.run(0.1)
    assert not served.link.texts
    served.ask(write("MPC_XY_P", 1.0))
    served.run(1.5)
    assert [text for _, text in served.link.texts] == [
        "37 parameters stored, no effect here: ./xtdrone gcs check FILE lists them"
    ]


# files


def test_written_values_outlive_the_vehicle(tmp_path):
    file = tmp_path / "params" / "iris_0.params"
    defaults = {"MAV_SYS_ID": SYSTEM, "MC_ROLL_P": 6.0}
    served = Served(Parameters(defaults, file))
    served.ask(write("MPC_XY_P", 0.7))
    served.ask(write("NAV_DLL_ACT", struct.unpack("<f", struct.pack("<i", 2))[0], INT32))
    lines = [line.split("\t") for line in file.read_text().splitlines() if not line.startswith("#")]
    assert [(row[:3], row[4]) for row in lines] == [
        ([str(SYSTEM), "1", "MPC_XY_P"], "9"),
        ([str(SYSTEM), "1", "NAV_DLL_ACT"], "6"),
    ]
    assert [entry.name for entry in file.parent.iterdir()] == [file.name], "no draft is left"
    again = Parameters(defaults, file)
    assert again.hash() == served.parameters.hash()
    assert again.get("MPC_XY_P") == served.parameters.get("MPC_XY_P")


def test_a_file_of_qgroundcontrol_is_read(tmp_path):
    file = tmp_path / "iris_0.params"
    file.write_text(
        "# Onboard parameters for Vehicle 1\n#\n# Vehicle-Id Component-Id Name Value Type\n"
        "1\t1\tMPC_XY_CRUISE\t7.500000000000000000\t9\n1\t1\tNAV_DLL_ACT\t3\t6\n"
    )
    parameters = Parameters(file=file)
    assert (parameters.get("MPC_XY_CRUISE"), parameters.get("NAV_DLL_ACT")) == (7.5, 3)


def test_invalid_entries_are_reported_and_skipped(tmp_path, caplog):
    file = tmp_path / "iris_0.params"
    file.write_text(
        "1\t1\tNO_SUCH\t1.0\t9\n1\t1\tMPC_XY_P\tmuch\t9\n1\t1\tMPC_XY_P\t1\t6\nMPC_XY_P 1\n1\t1\tMAV_SYS_ID\t9\t6\n"
        "1\t1\tMPC_XY_VEL_MAX\tnan\t9\n1\t1\tMPC_Z_P\t0.8\t9\n"
    )
    with caplog.at_level(logging.WARNING):
        parameters = Parameters({"MAV_SYS_ID": 3}, file)
    warnings = [record.getMessage() for record in caplog.records]
    assert len(warnings) == 6
    assert all(str(file) in text for text in warnings)
    for word in ("NO_SUCH", "line 2", "type 6", "line 4", "MAV_SYS_ID", "finite"):
        assert any(word in text for text in warnings), word
    assert (parameters.get("MAV_SYS_ID"), parameters.get("MPC_XY_P"), parameters.get("MPC_Z_P")) == (3, 0.95, 0.8)


def test_an_unreadable_file_leaves_the_defaults(tmp_path, caplog):
    file = tmp_path / "iris_0.params"
    file.write_bytes(b"\xff\xfe\x00broken")
    with caplog.at_level(logging.WARNING):
        assert Parameters(file=file).hash() == Parameters().hash()
    assert str(file) in caplog.text


def test_a_file_that_cannot_be_written_is_warned_of(tmp_path, caplog):
    (tmp_path / "taken").write_text("")
    parameters = Parameters(file=tmp_path / "taken" / "iris_0.params")
    with caplog.at_level(logging.WARNING):
        assert not parameters.save()
    assert "taken" in caplog.text
    assert Parameters().save(), "nothing to keep, nothing goes wrong"


# message types that pymavlink does not have


def test_message_types_are_described_as_pymavlink_does():
    for name, fields in {
        "PING": "uint64_t time_usec, uint32_t seq, uint8_t target_system, uint8_t target_component",
        "PARAM_VALUE": "char[16] param_id, float param_value, uint8_t param_type, uint16_t param_count,"
        "uint16_t param_index",
        "TUNNEL": "uint8_t target_system, uint8_t target_component, uint16_t payload_type, uint8_t payload_length,"
        "uint8_t[128] payload",
    }.items():
        theirs = dialect.MESSAGES[dialect.MESSAGE_ID[name]]
        ours = dialect.message_type(theirs.id, name, fields)
        assert ours.crc_extra == theirs.crc_extra, name
        assert list(ours.ordered_fieldnames) == theirs.ordered_fieldnames
        assert list(ours.fieldtypes) == theirs.fieldtypes
        assert ours.unpacker.format == theirs.unpacker.format
        assert list(ours.lengths) == theirs.lengths
