"""Bags converted to other formats keep their contents."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pytest
from bags import Bag, helix, make_flight
from rosbags.highlevel import AnyReader

from xtdrone_interaction import cli
from xtdrone_interaction.recording.flight_from_bag import read_bag


def contents(path: Path) -> list[tuple[str, int, Any]]:
    """Return topic, time, and position or mode of all messages."""
    found = []
    with AnyReader([path]) as reader:
        for connection, time, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            what = message.mode if hasattr(message, "mode") else None
            if hasattr(message, "pose"):
                what = (message.pose.position.x, message.header.stamp.sec, message.header.stamp.nanosec)
            found.append((connection.topic, time, what))
    return sorted(found, key=lambda row: row[:2])


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    make_flight(tmp_path / "flight.bag", ("/uav0", "/uav1"), 4.0)
    return tmp_path / "flight.bag"


@pytest.mark.parametrize("form", ["mcap", "ros2", "bag"])
def test_other_bags_hold_the_same(bag: Path, tmp_path: Path, form: str) -> None:
    out = tmp_path / ("out.bag" if form == "bag" else "out")
    assert cli.main(["convert", str(bag), "--to", form, "--out", str(out)]) == 0
    assert contents(out) == contents(bag)
    places = [read_bag([path]).vehicles[1].position for path in (bag, out)]
    assert np.array_equal(places[0].value, places[1].value)  # type: ignore[union-attr]


def test_a_bag_that_is_cut_off_becomes_whole(bag: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    cut = tmp_path / "cut.bag"
    cut.write_bytes(bag.read_bytes()[:30_000])
    for form, name in (("bag", "cut-whole.bag"), ("mcap", "cut-mcap")):
        assert cli.main(["convert", str(cut), "--to", form]) == 0
        assert "Note: it is cut off" in capfd.readouterr().out
        found = contents(tmp_path / name)
        assert found == [row for row in contents(bag) if row in found]
        assert len(found) > 50
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_tables_hold_the_same(bag: Path, flight_bag: Path, tmp_path: Path, form: str) -> None:
    out = tmp_path / "out"
    assert cli.main(["convert", str(bag), "--to", form, "--out", str(out), "--topics", "/uav?/mavros/*"]) == 0
    read = pyarrow.csv.read_csv if form == "csv" else pyarrow.parquet.read_table
    assert len(list(out.iterdir())) == 6
    table = read(out / f"uav1_mavros_local_position_pose.{form}")
    time = np.array(table["header.stamp.sec"]) + 1e-9 * np.array(table["header.stamp.nanosec"])
    places = np.column_stack([table[f"pose.position.{axis}"] for axis in "xyz"])
    np.testing.assert_allclose(places, helix(time, 10.0), atol=1e-8)
    np.testing.assert_array_equal(table["bag_time_ns"], np.round(1e9 * time))
    assert set(read(out / f"uav0_mavros_state.{form}")["mode"].to_pylist()) == {"AUTO.LOITER", "OFFBOARD"}

    out = tmp_path / "more"
    wanted = ["/gazebo/*", "/xtdrone/formation_pattern", "/rosout"]
    assert cli.main(["convert", str(flight_bag), "--to", form, "--out", str(out), "--topics", *wanted]) == 0
    models = read(out / f"gazebo_model_states.{form}").slice(0, 1).to_pylist()[0]
    load = json.loads if form == "csv" else lambda value: value
    assert load(models["name"])[:2] == ["ground_plane", "iris_0"]
    assert len(load(models["pose.position.x"])) == 10
    pattern = read(out / f"xtdrone_formation_pattern.{form}").slice(0, 1).to_pylist()[0]
    assert len(json.loads(pattern["data"])) == 24  # layout.dim has strings in a list: field by field as JSON


def test_damaged_messages_are_skipped_and_reported(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Skipped are a string longer than its message, a pattern with half its layout, and additional bytes."""
    path = tmp_path / "flight.bag"
    kind = "std_msgs/msg/Float32MultiArray"
    with Bag(path) as bag:
        layout = bag.type("std_msgs/msg/MultiArrayLayout")(dim=[], data_offset=0)
        good = bag.type(kind)(layout=layout, data=np.arange(6, dtype=np.float32))
        for k in range(4):
            bag.text("/words", "word", k)
            bag.write("/pattern", kind, good, k)
        raw = bytes(bag.store.serialize_ros1(good, kind))
        words, pattern = bag.connections["/words", "std_msgs/msg/String"], bag.connections["/pattern", kind]
        for time, connection, bad in ((4, words, b"\xff\0\0\0abc"), (5, words, b""), (6, pattern, raw[:6])):
            bag.writer.write(connection, time * 10**9, bad)
        bag.text("/words", "last", 7)
        bag.writer.write(words, 8 * 10**9, b"\x01\0\0\0abc")
        only = bag.writer.add_connection("/only", "std_msgs/msg/String", typestore=bag.store)
        bag.writer.write(only, 9 * 10**9, b"x")
    for form in ("csv", "parquet", "mcap"):
        assert cli.main(["convert", str(path), "--to", form]) == 0
        out = capfd.readouterr().out
        assert "Note: 3 messages of /words do not match their definition; skipped (the first at 4.000 s" in out
        assert "Note: 1 messages of /pattern do not match their definition; skipped (the first at 6.000 s" in out
        assert "its 6 bytes are no std_msgs/Float32MultiArray" in out
        assert "Note: 1 messages of /only" in out
    assert pyarrow.csv.read_csv(tmp_path / "flight-csv" / "words.csv")["data"].to_pylist() == ["word"] * 4 + ["last"]
    assert len(pyarrow.parquet.read_table(tmp_path / "flight-parquet" / "pattern.parquet")) == 4
    assert sorted(table.stem for table in (tmp_path / "flight-csv").iterdir()) == ["pattern", "words"]
    with AnyReader([tmp_path / "flight-mcap"]) as reader:
        assert len(list(reader.messages())) == 9
    assert cli.main(["convert", str(path), "--to", "csv", "--topics", "/only", "--out", str(tmp_path / "none")]) == 1
    assert "that can be read; 1 messages of /only" in capfd.readouterr().err


def test_invalid_conversions_are_reported(bag: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "there").mkdir()
    for arguments, status, words in (
        ([str(bag), "--to", "csv", "--out", str(tmp_path / "there")], 2, "exists already"),
        ([str(bag), "--to", "csv", "--topics", "/none"], 1, "no messages on the selected topics"),
        ([str(bag), "--to", "mcap", "--topics", "/none"], 1, "no messages on the selected topics"),
        ([str(tmp_path / "no.bag"), "--to", "mcap"], 1, "does not exist"),
    ):
        assert cli.main(["convert", *arguments]) == status, arguments
        assert words in capfd.readouterr().err, arguments
    assert not (tmp_path / "flight-csv").exists()
