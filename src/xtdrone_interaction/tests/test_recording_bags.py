"""Reading bags: every intact message of a damaged file."""

from __future__ import annotations

import bz2
import json
import re
import struct
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bags import CLIMB, POSE, RADIUS, TURN, Bag, helix, make_flight
from lz4.frame import LZ4FrameCompressor
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer

from xtdrone_interaction import cli
from xtdrone_interaction.bags import ros1bag
from xtdrone_interaction.bags.bag_kinds import large_batches
from xtdrone_interaction.bags.decode import Layout
from xtdrone_interaction.bags.ros1bag import BagFile
from xtdrone_interaction.metrics.vehicle_metrics import vehicle_metrics
from xtdrone_interaction.missions.formation.metrics import measure
from xtdrone_interaction.missions.formation.record import formation_of, read_formation, save_formation
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.recorded_flight import Recording
from xtdrone_interaction.recording.series_in_bounded_memory import Columns

Message = tuple[str, int, bytes]


def read(path: Path) -> tuple[list[Message], list[str]]:
    """Return all messages in the order of the file, and the notes."""
    bag = BagFile(path)
    found = []
    for data, connection, time, offset, length in bag.batches():
        for number, at, start, size in zip(connection, time, offset, length, strict=True):
            topic = bag.connections[int(number)].topic
            found.append((topic, int(at), data[start : start + size].tobytes()))
    return found, bag.notes


def small_bag(path: Path, packing: str) -> list[Message]:
    """Write a bag of several chunks and return its messages as rosbags reads them."""
    with Bag(path, packing, threshold=1500) as bag:
        for k in range(30):
            bag.pose("/iris_0", helix(k), float(k))
            bag.text("/words", "x" * k, k + 0.5)
    with AnyReader([path]) as reader:
        return [(c.topic, time, bytes(raw)) for c, time, raw in reader.messages()]


@pytest.mark.parametrize("packing", ["", "lz4", "bz2"])
def test_a_bag_cut_off_anywhere_gives_its_beginning(tmp_path: Path, packing: str) -> None:
    path = tmp_path / "whole.bag"
    expected = small_bag(path, packing)
    assert read(path) == (expected, [])
    data = path.read_bytes()
    marks = [m.start() for m in re.finditer(rb"op=|conn=|compression=", data)]
    chosen = np.random.default_rng(0).integers(13, len(data), 60).tolist()
    cuts = sorted({c for mark in marks for c in (mark - 5, mark - 4, mark, mark + 4)} | set(chosen))
    most = 0
    for cut in cuts:
        if not 13 < cut < len(data):
            continue
        (tmp_path / "cut.bag").write_bytes(data[:cut])
        found, notes = read(tmp_path / "cut.bag")
        assert found == expected[: len(found)], cut
        assert notes or len(found) == len(expected), cut
        assert len(found) >= most, cut  # a longer file yields at least as many messages
        most = len(found)
    assert most == len(expected)


def test_the_chunk_that_was_being_written_is_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "whole.bag"
    expected = small_bag(path, "")
    data = bytearray(path.read_bytes())
    chunks = [m.start() for m in re.finditer(rb"op=\x05", data)]
    field = data.index(b"size=", chunks[-1])
    index = data.index(b"op=\x04", chunks[-1])
    data[field + 5 : field + 13] = bytes(8)  # sizes that the recorder fills in at the end
    data = data[: index - 60]
    at = data.index(b"index_pos=")
    data[at + 10 : at + 18] = bytes(8)
    (tmp_path / "flight.bag.active").write_bytes(data)
    found, notes = read(tmp_path / "flight.bag.active")
    assert len(expected) - 3 < len(found) < len(expected)
    assert found == expected[: len(found)]
    assert any("cut off in the chunk" in note for note in notes)
    assert any("no index" in note for note in notes)


@pytest.mark.parametrize("packing", ["", "lz4", "bz2"])
def test_damage_affects_only_the_damaged_part(tmp_path: Path, packing: str) -> None:
    path = tmp_path / "whole.bag"
    expected = small_bag(path, packing)
    data = bytearray(path.read_bytes())
    chunks = [m.start() for m in re.finditer(rb"op=\x05", data)]
    assert len(chunks) > 4
    data[chunks[1] - 8 : chunks[1] + 60] = b"\xff" * 68  # the second chunk's header
    (tmp_path / "bad.bag").write_bytes(data)
    found, notes = read(tmp_path / "bad.bag")
    assert set(found) < set(expected)
    assert found[0] == expected[0]
    assert found[-1] == expected[-1]
    assert len(found) > 0.6 * len(expected)
    assert any("damaged" in note for note in notes)


def records(data: bytes) -> Iterator[tuple[bytes, int]]:
    """Yield each record's header, and the position of the size of its data."""
    at = len(b"#ROSBAG V2.0\n")
    while at < len(data):
        body = at + 4 + int.from_bytes(data[at : at + 4], "little")
        yield data[at + 4 : body], body
        at = body + 4 + int.from_bytes(data[body : body + 4], "little")


@pytest.mark.parametrize("packing", ["", "lz4", "bz2"])
@pytest.mark.parametrize("kind", [b"op=\x05", b"op=\x04"])
def test_a_wrong_size_does_not_hide_the_following_entries(tmp_path: Path, packing: str, kind: bytes) -> None:
    """They are found although the size of a chunk or an index lies far beyond the end of the file."""
    path = tmp_path / "whole.bag"
    expected = small_bag(path, packing)
    data = bytearray(path.read_bytes())
    place = [place for header, place in records(data) if kind in header][1]
    data[place : place + 4] = b"\xff\xff\xff\x7f"
    (tmp_path / "bad.bag").write_bytes(data)
    found, notes = read(tmp_path / "bad.bag")
    assert notes
    assert found == expected


def test_a_chunk_whose_last_byte_is_wrong_is_read_and_noted(tmp_path: Path) -> None:
    path = tmp_path / "whole.bag"
    expected = small_bag(path, "lz4")
    data = bytearray(path.read_bytes())
    place = next(place for header, place in records(data) if b"op=\x05" in header)
    data[place + 3 + int.from_bytes(data[place : place + 4], "little")] ^= 1
    (tmp_path / "bad.bag").write_bytes(data)
    found, notes = read(tmp_path / "bad.bag")
    assert found == expected
    assert any("cannot be decompressed further" in note for note in notes)


def test_damaged_topic_descriptions_are_read_from_the_index(tmp_path: Path) -> None:
    path = tmp_path / "whole.bag"
    expected = small_bag(path, "")
    data = bytearray(path.read_bytes())
    first = next(place for header, place in records(data) if b"op=\x05" in header)
    data[first + 4 : first + 8] = b"\xff\xff\xff\x7f"  # the chunk's first record
    (tmp_path / "bad.bag").write_bytes(data)
    found, notes = read(tmp_path / "bad.bag")
    assert any("that are no record" in note for note in notes)
    assert found == expected[-len(found) :]
    assert len(found) > 0.8 * len(expected)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"PK\x03\x04 an archive", "is not a bag"),
        (b"ULog\x01\x12\x35\x01", "Header too short"),  # a flight log, whatever its name
        (b"#ROSBAG V1.2\n" + bytes(100), "version '1.2'"),
        (
            b"#ROSBAG V2.0\n\x2e\0\0\0\x10\0\0\0encryptor=secret\x04\0\0\0op=\x03\x0e\0\0\0index_pos=abcd\0\0\0\0",
            "encrypted",
        ),
    ],
)
def test_other_files_are_reported(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], content: bytes, words: str
) -> None:
    path = tmp_path / "bad.bag"
    path.write_bytes(content)
    assert cli.main(["analyse", str(path)]) == 1
    error = capfd.readouterr().err
    assert words in error
    assert str(path) in error


def test_missing_files_and_folders_are_reported(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["analyse", str(tmp_path / "no.bag")]) == 1
    assert "does not exist" in capfd.readouterr().err
    assert cli.main(["analyse", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert "no metadata.yaml" in capfd.readouterr().err
    (tmp_path / "file").touch()
    assert cli.main(["analyse", str(tmp_path / "file"), "--out", str(tmp_path / "file")]) == 2


def test_layouts_agree_with_rosbags(tmp_path: Path, flight_bag: Path) -> None:
    """Decoded numbers and texts of a flight equal those of rosbags; a message that is too short is left out."""
    bag = BagFile(flight_bag)
    checked = set()
    for batch in large_batches(bag):
        for number, connection in bag.connections.items():
            rows = np.flatnonzero(batch.connection == number)[:50]
            layout = Layout(connection.type, connection.definition)
            length = batch.length[rows].copy()
            length[0] -= 1
            wanted = {*layout.fields, *layout.texts}
            decoded = layout.decode(batch.data, batch.offset[rows], length, wanted)
            if layout.traversable:
                assert decoded.kept.tolist() == list(range(1, len(rows))), connection
            texts = {path: decoded.texts(path) for path in layout.texts if path in decoded.found}
            for place, row in enumerate(decoded.kept.tolist()):
                start = batch.offset[rows[row]]
                raw = batch.data[start : start + batch.length[rows[row]]].tobytes()
                message = layout.store.deserialize_ros1(raw, layout.type)
                for path in wanted & decoded.found.keys():
                    value = message
                    for name in path.split("."):
                        value = getattr(value, name)
                    found = texts[path][place] if path in texts else decoded.found[path][place]
                    assert np.array_equal(found, value), (connection.topic, path)
                    checked.add(connection.type)
    assert {"geometry_msgs/PoseStamped", "std_msgs/String"} <= checked


def flight_of(tmp_path: Path, **options: object) -> Recording:
    path = tmp_path / "made.bag"
    make_flight(path, **options)  # type: ignore[arg-type]
    return read_bag([path])


@pytest.mark.parametrize("more", ["bool manual_input\n", ""])
def test_real_mavros_under_any_namespace(tmp_path: Path, more: str) -> None:
    """Bags with dates instead of simulated time, other namespaces and an older State are read."""
    spaces = ("/uav0", "", "/team/uav10", "/team/uav9")
    flight = flight_of(tmp_path, spaces=spaces, seconds=10.0, start=1.7e9, more=more)
    assert [v.name for v in flight.vehicles] == ["mavros", "team_uav9", "team_uav10", "uav0"]
    assert flight.origin == pytest.approx(1.7e9 + 0.5)
    for vehicle in flight.vehicles:
        centre = 10.0 * [s.strip("/").replace("/", "_") or "mavros" for s in spaces].index(vehicle.name)
        place = vehicle.position
        assert place is not None
        np.testing.assert_allclose(place.value, helix(place.time + 0.5, centre), atol=1e-5)
        assert vehicle.modes == [(pytest.approx(0.0, abs=1e-6), "AUTO.LOITER"), (pytest.approx(1.5), "OFFBOARD")]
        assert [armed for _, armed in vehicle.armed] == [False, True]
        figures = vehicle_metrics(vehicle)
        assert figures["greatest_speed"] == pytest.approx(RADIUS * TURN, rel=1e-3)
        assert figures["greatest_climb"] == pytest.approx(CLIMB)
        assert figures["way"] == pytest.approx(9.95 * np.hypot(RADIUS * TURN, CLIMB), abs=0.3)
        assert figures["highest"] == pytest.approx(9.95 * CLIMB, abs=1e-3)
        assert figures["modes"]["OFFBOARD"] == pytest.approx(8.45)
        assert figures["armed_time"] == pytest.approx(9.45)


def test_without_velocities_they_are_derived_from_positions(tmp_path: Path) -> None:
    with Bag(tmp_path / "made.bag") as bag:
        for k in range(200):
            bag.pose("/iris_0", helix(0.05 * k), 0.05 * k + 1.0)
    (vehicle,) = read_bag([tmp_path / "made.bag"]).vehicles
    speed = np.linalg.norm(vehicle.series["velocity"].value[2:-2], axis=1)
    np.testing.assert_allclose(speed, np.hypot(RADIUS * TURN, CLIMB), rtol=1e-3)


def test_invalid_positions_are_skipped_and_reported(tmp_path: Path) -> None:
    with Bag(tmp_path / "made.bag") as bag:
        for k in range(100):
            bag.pose("/iris_0", (2.7e306, 0.0, 0.0) if k == 50 else helix(0.1 * k), 0.1 * k)
    flight = read_bag([tmp_path / "made.bag"])
    assert flight.notes == ["1 positions of iris_0 pose are out of range, and left out"]
    place = flight.vehicles[0].position
    assert place is not None
    np.testing.assert_allclose(place.value, helix(place.time), atol=1e-6)


def test_a_thousand_topics_and_an_unknown_definition(tmp_path: Path) -> None:
    path = tmp_path / "many.bag"
    with Writer(path) as writer:
        made = Bag(tmp_path / "unused.bag").store
        kind = "std_msgs/msg/String"
        raw = made.serialize_ros1(made.types[kind](data="word"), kind)
        _, md5 = made.generate_msgdef(POSE)
        for number in range(1000):
            connection = writer.add_connection(f"/topic_{number}", kind, typestore=made)
            writer.write(connection, number, raw)
        odd = writer.add_connection("/odd/mavros/local_position/pose", "odd/msg/Odd", msgdef="int32 [", md5sum=md5)
        writer.write(odd, 5, b"1234")
        other = writer.add_connection("/other/mavros/local_position/pose", kind, typestore=made)
        writer.write(other, 6, raw)
    flight = read_bag([path])
    assert len(flight.topics) == 1002
    assert sum(topic.count for topic in flight.topics) == 1002
    assert flight.vehicles == []
    text = " ".join(flight.notes)
    assert "odd/Odd" in text
    assert "/other/mavros/local_position/pose of type std_msgs/String" in text


def test_a_recording_that_was_split_is_one(tmp_path: Path) -> None:
    """Its files are joined although connections have other numbers in each."""
    for number, spaces in enumerate((["/iris_0", "/iris_1"], ["/iris_1", "/iris_0"], ["/iris_1"])):
        with Bag(tmp_path / f"flight_{number}.bag") as bag:
            for k in range(100 * number, 100 * number + 100):
                for space in spaces:
                    bag.pose(space, helix(0.1 * k, float(space[-1])), 0.1 * k)
    paths = sorted(tmp_path.glob("*.bag"))
    paths[2].write_bytes(paths[2].read_bytes()[:9000])
    assert cli.main(["analyse", *map(str, paths)]) == 0
    page = (tmp_path / "flight_0-analysis" / "report.html").read_text()
    assert "flight_2.bag: it is cut off" in page
    flight = read_bag(paths)
    assert [topic.publishers for topic in flight.topics] == [1, 1]
    first, second = (vehicle.position for vehicle in flight.vehicles)
    assert first is not None and second is not None  # noqa: PT018
    assert len(first) == 200
    assert 200 < len(second) < 300
    np.testing.assert_allclose(second.value, helix(second.time, 1.0), atol=1e-6)
    (tmp_path / "log.ulg").touch()
    assert cli.main(["analyse", str(paths[0]), str(tmp_path / "log.ulg")]) == 1


def test_memory_of_long_recordings_is_bounded() -> None:
    columns = Columns(most=40_000)
    tracemalloc.start()
    for k in range(1000):
        time = np.arange(1000.0) + 1000 * k
        columns.add(("a", "pose"), time, np.column_stack([time, 2 * time]))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 3 * 8 * 40_000  # bytes; dropped data is not kept alive by the stored data
    series = columns.series()["a", "pose"]
    assert 5_000 < len(series) < 14_000
    assert columns.stride > 1
    assert (np.diff(series.time) == columns.stride).all()
    np.testing.assert_array_equal(series.value[:, 1], 2 * series.time)


def test_formation_flights_are_judged_as_by_the_report(flight_bag: Path) -> None:
    expected, found = read_formation(flight_bag), formation_of(read_bag([flight_bag]))
    assert found is not None
    assert measure(found, found.track) == measure(expected, expected.track)


def test_a_formation_flight_cut_off_is_judged_as_far_as_it_goes(flight_bag: Path, tmp_path: Path) -> None:
    data = flight_bag.read_bytes()
    path = tmp_path / "cut.bag"
    path.write_bytes(data[: len(data) * 6 // 10])
    assert cli.main(["analyse", str(path), "--out", str(tmp_path / "out")]) == 0
    figures = json.loads((tmp_path / "out" / "report.json").read_text())
    assert figures["cut_off"]
    patterns = [item["pattern"] for item in figures["formation"]["reconfigurations"]]
    assert patterns == ["origin", "cube", "pyramid"][: len(patterns)]
    assert len(patterns) >= 2
    page = (tmp_path / "out" / "report.html").read_text()
    assert "is cut off" in page
    assert all(source.startswith("data:image/png;base64,") for source in re.findall(r'src="([^"]*)', page))
    assert "http" not in page.replace("https://", "")
    names = {path.stem for path in (tmp_path / "out").glob("*.png")}
    assert {"positions", "tracks", "velocities", "response_1_origin_to_cube", "formations", "distances"} <= names


def test_report_and_analysis_of_a_recorder_that_was_killed_agree(flight_bag: Path, tmp_path: Path) -> None:
    """Both use the events' file beside the bag, which continues to the flight's end."""
    path = tmp_path / "flight.bag"
    path.write_bytes(flight_bag.read_bytes()[: flight_bag.stat().st_size * 6 // 10])
    events = [json.dumps(event) for event in read_formation(flight_bag).events]
    (tmp_path / "events.jsonl").write_text("\n".join(events) + "\n")
    assert cli.main(["report", str(path)]) == 1
    assert cli.main(["analyse", str(path), "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    analysis = json.loads((tmp_path / "out" / "report.json").read_text())
    assert analysis["cut_off"]
    assert {key: report[key] for key in analysis["formation"]} == analysis["formation"]
    assert report["outcome"] == "done"
    assert report["unrecorded"]
    assert any("the record is cut: positions end at" in text for text in analysis["formation"]["shortcomings"])


def test_damage_in_the_middle_is_no_cut(flight_bag: Path, tmp_path: Path) -> None:
    data = bytearray(flight_bag.read_bytes())
    chunks = [m.start() for m in re.finditer(rb"op=\x05", data)]
    data[chunks[1] - 8 : chunks[1] + 60] = b"\xff" * 68
    (tmp_path / "bad.bag").write_bytes(data)
    recording = read_bag([tmp_path / "bad.bag"])
    assert any("damaged" in note for note in recording.notes)
    assert not recording.cut


def test_an_archive_of_a_flight_without_ros_is_analysed(flight_bag: Path, tmp_path: Path) -> None:
    record = read_formation(flight_bag)
    topologies = [replace(record.topologies[0], time=change.time) for change in record.patterns]  # one per pattern
    save_formation(replace(record, topologies=topologies), tmp_path / "flight.npz")
    assert cli.main(["analyse", str(tmp_path / "flight.npz")]) == 0
    figures = json.loads((tmp_path / "flight-analysis" / "report.json").read_text())
    assert figures["formation"]["outcome"] == "done"
    assert len(figures["formation"]["reconfigurations"]) == 4
    assert (tmp_path / "flight-analysis" / "tracks.png").is_file()


def packed_bomb(path: Path, packing: str, stated: int, begin: bytes, megabytes: int) -> None:
    """Append a chunk to a bag that holds ``begin`` and then zeros."""
    packer = bz2.BZ2Compressor() if packing == "bz2" else LZ4FrameCompressor()
    first = packer.begin() if packing == "lz4" else b""
    data = first + packer.compress(begin) + b"".join(packer.compress(bytes(1 << 20)) for _ in range(megabytes))
    data += packer.flush()
    fields = [b"op=\x05", b"compression=" + packing.encode(), b"size=" + struct.pack("<I", stated)]
    header = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    with path.open("ab") as file:
        file.write(struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data)


@pytest.mark.parametrize(
    ("packing", "stated", "length", "words"),
    [("lz4", 1000, 0xFFFFFFF0, "holds more than its stated size"), ("lz4", 0xFFFFFFFF, 0xFFFFFFF0, "has a record of"),
     ("lz4", 0xFFFFFFFF, 0, ""), ("bz2", 1000, 0, "holds more than its stated size"),
     ("bz2", 0xFFFFFFFF, 0xFFFFFFF0, "has a record of more than")],
)  # fmt: skip
def test_a_chunk_that_unpacks_to_far_more_than_it_should_fills_no_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, packing: str, stated: int, length: int, words: str
) -> None:
    monkeypatch.setattr(ros1bag, "_LONGEST_RECORD", 1 << 22)
    monkeypatch.setattr(ros1bag, "_USUAL_CHUNK", 1 << 22)
    path = tmp_path / "bomb.bag"
    expected = small_bag(path, "")
    fields = [b"op=\x02", b"conn=" + bytes(4), b"time=" + bytes(8)]
    header = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    record = struct.pack("<I", len(header)) + header + struct.pack("<I", length)
    packed_bomb(path, packing, stated, record if length else b"", 80)
    assert path.stat().st_size < 1e6
    tracemalloc.start()
    found, notes = read(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found == expected
    assert words in "; ".join(notes)
    assert notes
    assert most < 5e7


def test_an_empty_bag_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_flight(tmp_path / "whole.bag", ["/iris_0"], 1.0)
    stump = tmp_path / "stump.bag"
    stump.write_bytes((tmp_path / "whole.bag").read_bytes()[:100])
    assert cli.main(["analyse", str(stump), "--out", str(tmp_path / "out")]) == 1
    assert f"bag: '{stump}' has no messages that can be read; it is cut off" in capsys.readouterr().err
