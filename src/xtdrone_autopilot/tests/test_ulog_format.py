"""The ULog writer, read back by pyulog."""

from __future__ import annotations

import io
import math
import string

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyulog import ULog

from xtdrone_autopilot.logger import ulog_format
from xtdrone_autopilot.logger.message_definitions import message_format
from xtdrone_autopilot.logger.ulog_format import Field, Format, UlogError, UlogWriter

_BASIC = sorted(set(ulog_format.TYPES) - {"char"})
_POINT = Format.parse("point", "uint64_t timestamp;float x;uint8_t kind;uint8_t[3] _padding0")


def read(data: bytes, capsys=None) -> ULog:
    """Read a log; it must be free of errors."""
    log = ULog(io.BytesIO(data))
    assert not log.file_corruption
    if capsys is not None:
        assert capsys.readouterr().out == ""
    return log


def writer(*layouts: Format, start_us: int = 0) -> tuple[UlogWriter, io.BytesIO]:
    sink = io.BytesIO()
    made = UlogWriter(sink, start_us)
    for layout in layouts:
        made.add_format(layout)
    for number, layout in enumerate(layouts):
        made.subscribe(number, layout)
    return made, sink


names = st.text(string.ascii_lowercase + "_", min_size=1, max_size=12).filter(lambda n: not n.startswith("_padding"))


@st.composite
def formats(draw, nested: tuple[Format, ...] = ()):
    """Return a format with a timestamp, its fields in any order, with or without padding at the end."""
    fields = [Field("uint64_t", 0, "timestamp")]
    kinds = _BASIC + [inner.name for inner in nested]
    for name in draw(st.lists(names.filter(lambda n: n != "timestamp"), unique=True, max_size=6)):
        fields.append(Field(draw(st.sampled_from(kinds)), draw(st.integers(0, 5)), name))
    fields = draw(st.permutations(fields))
    if draw(st.booleans()):
        fields.append(Field("uint8_t", draw(st.integers(1, 7)), "_padding0"))
    name = draw(names.map(lambda n: n + "_topic"))
    used = tuple(inner for inner in nested if any(f.type == inner.name for f in fields))
    return Format(name, tuple(fields), used)


def flat(record, prefix=""):
    """Return a record's values by their names in pyulog."""
    found = {}
    for name in record.dtype.names:
        value = record[name]
        parts = {prefix + name: value}
        if record.dtype[name].subdtype is not None:
            parts = {f"{prefix}{name}[{i}]": element for i, element in enumerate(value)}
        for key, part in parts.items():
            found |= flat(part, key + ".") if part.dtype.names else {key: part}
    return found


@settings(max_examples=120, deadline=None)
@given(st.data())
def test_any_topic_survives(data):
    inner = data.draw(formats())
    layout = data.draw(formats(nested=(inner,)))
    if layout.name == inner.name:
        return
    made, sink = writer(layout)
    dtype = ulog_format.data_dtype(layout)
    count = data.draw(st.integers(1, 4))
    messages = np.empty(count, dtype)
    messages[...] = ulog_format.data_template(layout, 0)
    size = layout.dtype.itemsize
    for i in range(count):
        raw = bytearray(data.draw(st.binary(min_size=size, max_size=size)))
        record = np.frombuffer(raw, layout.dtype)[0].copy()
        messages["record"][i] = record
        messages["record"]["timestamp"][i] = 1000 * (i + 1)
    made.add_messages(messages.tobytes())
    made.flush()
    (found,) = read(sink.getvalue()).data_list
    assert found.name == layout.name
    for i in range(count):
        for key, value in flat(messages["record"][i]).items():
            if key.rsplit(".", 1)[-1].startswith("_padding"):
                continue
            back = found.data[key][i]
            if value.dtype == bool:  # any byte but 0 is true
                assert bool(back) == bool(value), key
            else:
                assert back.tobytes() == value.tobytes(), key


def test_everything_else_survives(capsys):
    sink = io.BytesIO()
    made = UlogWriter(sink, 5_000_000)
    made.add_info("char", "sys_name", "PX4")
    made.add_info("uint32_t", "ver_sw_release", 0x010E03FF)
    made.add_multi_info("boot", "first ")
    made.add_multi_info("boot", "second", continued=True)
    made.add_parameter("MPC_XY_P", 0.5)
    made.add_parameter("SDLOG_MODE", 1)
    made.add_default_parameter("MPC_XY_P", 0.95, ulog_format.SYSTEM_DEFAULT)
    made.add_default_parameter("SDLOG_MODE", 0, ulog_format.SYSTEM_DEFAULT | ulog_format.SETUP_DEFAULT)
    made.add_format(_POINT)
    made.subscribe(7, _POINT, 2)
    made.add_data(7, _POINT, {"timestamp": 5_000_100, "x": math.nan, "kind": 3})
    made.add_messages(ulog_format.logged_string(3, 5_000_200, "über alles"))
    made.add_parameter("MPC_XY_P", 0.75)
    made.add_messages(ulog_format.sync())
    made.add_messages(ulog_format.dropout(12))
    made.flush()
    assert made.written == len(sink.getvalue())
    log = read(sink.getvalue(), capsys)
    assert log.start_timestamp == 5_000_000
    assert log.msg_info_dict == {"sys_name": "PX4", "ver_sw_release": 0x010E03FF}
    assert log.get_version_info_str() == "v1.14.3"
    assert log.msg_info_multiple_dict == {"boot": [["first ", "second"]]}
    assert log.initial_parameters == {"MPC_XY_P": 0.5, "SDLOG_MODE": 1}
    assert log.get_default_parameters(0) == {"MPC_XY_P": pytest.approx(0.95), "SDLOG_MODE": 0}
    assert log.get_default_parameters(1) == {"SDLOG_MODE": 0}
    assert log.changed_parameters == [(5_000_100, "MPC_XY_P", 0.75)]
    (text,) = log.logged_messages
    assert (text.log_level_str(), text.timestamp, text.message) == ("ERROR", 5_000_200, "über alles")
    assert [d.duration for d in log.dropouts] == [12]
    (point,) = log.data_list
    assert (point.multi_id, point.msg_id) == (2, 7)
    assert math.isnan(point.data["x"][0])
    assert "_padding0[0]" not in point.data


def test_same_calls_same_bytes():
    files = []
    for _ in range(2):
        made, sink = writer(_POINT, start_us=3)
        made.add_data(0, _POINT, {"timestamp": 4, "x": 1.5})
        made.flush()
        files.append(sink.getvalue())
    assert files[0] == files[1]


def test_a_file_cut_anywhere_in_its_data_is_readable(capsys):
    made, sink = writer(_POINT)
    made.flush()
    definitions = made.written
    for i in range(20):
        made.add_data(0, _POINT, {"timestamp": i + 1, "x": i})
    made.flush()
    whole = sink.getvalue()
    size = ulog_format.data_dtype(_POINT).itemsize
    for end in range(definitions + size, len(whole) + 1):
        (point,) = read(whole[:end], capsys).data_list
        assert point.data["timestamp"].tolist() == list(range(1, (end - definitions) // size + 1))


def test_errors_name_the_element():
    made, _ = writer(_POINT)
    other = Format.parse("point", "uint64_t timestamp;double x")
    late = Format.parse("late", "uint64_t timestamp")
    timeless = Format.parse("timeless", "float x")
    huge = Format.parse("huge", "uint64_t timestamp;double[9000] x")
    cases = (
        (lambda: Format.parse("p", "real x"), "type 'real'"),
        (lambda: Format.parse("p", "float 2x"), "'float 2x'"),
        (lambda: Format.parse("p", "float[0] x"), "length 0"),
        (lambda: Format.parse("p", "float x;bool x"), "field x is defined twice"),
        (lambda: Format.parse("p q", "float x"), "'p q'"),
        (lambda: Format.parse("p", "uint8_t _padding0"), "no field"),
        (lambda: made.add_format(other), "other fields"),
        (lambda: made.add_format(late), "format late is too late"),
        (lambda: made.subscribe(1, late), "late"),
        (lambda: made.subscribe(0, _POINT), "message id 0 is taken by point"),
        (lambda: made.add_data(1, _POINT, {}), "message id 1"),
        (lambda: made.add_data(0, _POINT, {"y": 1}), "unknown field y"),
        (lambda: ulog_format.data_dtype(timeless), "timeless"),
        (lambda: ulog_format.data_dtype(huge), "huge"),
        (lambda: ulog_format.info("int8_t", "key", 128), "info key"),
        (lambda: ulog_format.info("char", "a key", "x"), "'a key'"),
        (lambda: ulog_format.info("float[2]", "key", 1.0), "float"),
        (lambda: ulog_format.info("char", "key", "x" * 70000), "info key"),
        (lambda: ulog_format.parameter("P", 1 << 31), "parameter P"),
        (lambda: ulog_format.parameter("P" * 250, 1), "at most 255"),
        (lambda: ulog_format.default_parameter("P", 1, 4), "kind 4"),
        (lambda: ulog_format.subscription(1 << 16, "point"), "65536"),
        (lambda: ulog_format.subscription(1, "point", 256), "256"),
        (lambda: ulog_format.logged_string(8, 0, "text"), "level 8"),
        (lambda: ulog_format.dropout(70000), "70000"),
    )
    for call, text in cases:
        with pytest.raises(UlogError) as error:
            call()
        assert text in str(error.value)


def test_px4s_layout():
    layout = message_format("vehicle_status")
    assert layout.definition.startswith(
        "vehicle_status:uint64_t timestamp;uint64_t armed_time;uint64_t takeoff_time;uint64_t nav_state_timestamp;"
        "uint16_t failure_detector_status;uint8_t arming_state;"
    )
    assert layout.definition.endswith("bool pre_flight_checks_pass;uint8_t[6] _padding0;")
    triplet = message_format("position_setpoint_triplet")
    assert [inner.name for inner in triplet.nested] == ["position_setpoint"]
    assert triplet.nested[0].inner_dtype.itemsize % 8 == 0
