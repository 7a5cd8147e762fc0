"""The reader of PX4's tables, and rules that the tables themselves obey."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from xtdrone_autopilot.logger.message_definitions import message_format
from xtdrone_autopilot.parameters.derived_records import SLOTS
from xtdrone_autopilot.parameters.parameters import NAMES
from xtdrone_autopilot.state import MAX_ROTORS
from xtdrone_autopilot.tables.reader import TableError, number, one_of, read_table

COLUMNS = {"name": str, "kind": one_of("a", "b"), "value": number}


def read(folder: Path, text: str) -> list[list]:
    (folder / "table.csv").write_text(text)
    return read_table("table", COLUMNS, folder)


def test_values_have_the_types_of_their_columns(tmp_path):
    rows = read(tmp_path, 'name,kind,value\n"x, y",a,3\nz,b,3.0\nz,b,1e-3\n')
    assert rows == [["x, y", "a", 3], ["z", "b", 3.0], ["z", "b", 0.001]]
    assert [type(row[2]) for row in rows] == [int, float, float]


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("name,value\n", ("line 1", "name,value")),
        ("", ("line 1", "name,kind,value")),
        ("name,kind,value\nx,a,1\nx,a\n", ("line 3", "2 values", "3")),
        ("name,kind,value\nx,c,1\n", ("line 2", "kind", "'c'", "a or b")),
        ("name,kind,value\nx,a,nothing\n", ("line 2", "value", "'nothing'", "number")),
    ],
)
def test_an_error_names_file_line_and_value(tmp_path, text, parts):
    with pytest.raises(TableError) as error:
        read(tmp_path, text)
    assert all(part in str(error.value) for part in ("table.csv", *parts))


@pytest.mark.parametrize("table", ["parameters", "former_parameters", "events", "streams", "mission_commands"])
def test_no_name_occurs_twice(table):
    path = Path(read_table.__code__.co_filename).with_name(f"{table}.csv")
    names = Counter(line.split(",")[0] for line in path.read_text().splitlines())
    assert [name for name, count in names.items() if count > 1] == []


def test_there_are_parameters_of_each_sensor_and_rotor():
    sensors = {f"CAL_{sensor}{slot}_PRIO" for sensor, slots in SLOTS.items() for slot in range(slots)}
    assert sensors | {f"CA_ROTOR{rotor}_CT" for rotor in range(MAX_ROTORS)} <= set(NAMES)


def test_a_message_is_padded_to_whole_words():
    assert message_format("takeoff_status").inner_dtype.itemsize % 8 == 0
