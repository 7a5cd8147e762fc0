"""Bags recorded from MAVROS 1.x, with its own definitions: several vehicles, latched and unknown topics, no truth."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import POSE, Bag, helix
from rosbags.typesys import get_types_from_msg

from xtdrone_interaction import cli
from xtdrone_interaction.pictures.recording_pictures import pictures
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.recorded_flight import Recording

SUMS = {  # of MAVROS master and common_msgs, as rosmsg md5 prints them
    "mavros_msgs/msg/State": "65cd0a9fff993b062b91e354554ec7e9",
    "mavros_msgs/msg/PositionTarget": "dedb0081aaf8cb20209737746bb49117",
    "mavros_msgs/msg/StatusText": "6cfd33cd09e4abf5841d7be3c770a969",
    "mavros_msgs/msg/WaypointList": "0605a2df153acd9a4a4823385ed81b57",
    "sensor_msgs/msg/Imu": "6a62c6daae103f4ff57a132d6f95cec2",
    "sensor_msgs/msg/NavSatFix": "2d3a8cd499b9b4a0249fb98fd05cfa48",
    "geometry_msgs/msg/PoseStamped": "d3812c3cbc69362b77dc0b19b345f8f5",
}
MESSAGES = Path(__file__).parents[2] / "msgs" / "mavros_msgs" / "msg"
START, SECONDS, RATE = 1.7e9, 12.0, 50.0
SHAKING, TURNING = 11.0, 4.0  # Hz
VELOCITY_ALONE = 0b100111000111


class MavrosBag(Bag):
    """Writes messages under MAVROS's definitions with their comments, and with its sums."""

    def __init__(self, path: Path, packing: str = "") -> None:
        super().__init__(path, packing, threshold=20_000, start=START)
        self.texts: dict[str, str] = {}
        for name in ("State", "PositionTarget", "StatusText", "Waypoint", "WaypointList"):
            kind = f"mavros_msgs/msg/{name}"
            self.texts[kind] = (MESSAGES / f"{name}.msg").read_text()
            self.store.fielddefs.pop(kind, None)
            self.store.types.pop(kind, None)
            self.store.register(get_types_from_msg(self.texts[kind], kind))
        self.store.register(get_types_from_msg("acme_msgs/Part[] parts\nstring why\n", "acme_msgs/msg/Odd"))
        self.store.register(get_types_from_msg("string name\nfloat64[] values\n", "acme_msgs/msg/Part"))

    def write(self, topic: str, kind: str, message: Any, time: float, late: float = 0.0, latching: int = 0) -> None:
        """Write a message that was recorded ``late`` s after its time."""
        if (topic, kind) not in self.connections:
            definition, md5 = self.store.generate_msgdef(kind)
            assert SUMS.get(kind, md5) == md5
            first, mark, rest = definition.partition("=" * 80)
            whole = self.texts.get(kind, first) + mark + rest
            caller = topic.partition("/mavros/")[0] + "/mavros"
            self.connections[topic, kind] = self.writer.add_connection(
                topic, kind, msgdef=whole, md5sum=md5, callerid=caller, latching=latching
            )
        raw = self.store.serialize_ros1(message, kind)
        self.writer.write(self.connections[topic, kind], round((self.start + time + late) * 1e9), raw)

    def zero(self, kind: str, **values: Any) -> Any:
        """Return a message with the given fields; all others are 0 or empty."""
        fields = {}
        for name, (node, what) in self.store.fielddefs[kind][1]:
            if name in values:
                fields[name] = values[name]
            elif node == 2:
                fields[name] = self.zero(what)
            elif node == 1:
                fields[name] = "" if what[0] == "string" else 0
            else:
                fields[name] = np.zeros(what[1] if node == 3 else 0, np.float64)
        return self.store.types[kind](**fields)

    def vehicle(self, space: str, time: float, number: int) -> None:
        """Write a vehicle's messages of one time."""
        header = self.header(time)
        shake = self.vector(0.0, 0.0, 9.81 + np.sin(2 * np.pi * SHAKING * time))
        turn = self.vector(0.3 * np.sin(2 * np.pi * TURNING * time), 0.0, 0.0)
        kind = "sensor_msgs/msg/Imu"
        imu = self.zero(kind, header=header, linear_acceleration=shake, angular_velocity=turn)
        self.write(f"{space}/mavros/imu/data_raw", kind, imu, time)
        if number % 5:
            return
        place = self.zero("geometry_msgs/msg/Pose", position=self.vector(*helix(time), kind="Point"))
        message = self.zero(POSE, header=header, pose=place)
        self.write(f"{space}/mavros/local_position/pose", POSE, message, time, 0.02)
        kind = "mavros_msgs/msg/PositionTarget"
        target = self.zero(kind, header=header, type_mask=VELOCITY_ALONE, velocity=self.vector(1.0, 2.0, 0.5))
        self.write(f"{space}/mavros/setpoint_raw/local", kind, target, time)
        if number % 50:
            return
        mode = "OFFBOARD" if time >= 4.0 else "POSCTL"
        kind = "mavros_msgs/msg/State"
        self.write(f"{space}/mavros/state", kind, self.zero(kind, header=header, mode=mode, armed=time >= 2.0), time)
        kind = "sensor_msgs/msg/BatteryState"
        battery = self.zero(kind, header=header, voltage=16.0 - 0.1 * time, percentage=-0.01, current=-12.0)
        self.write(f"{space}/mavros/battery", kind, battery, time)
        kind = "mavros_msgs/msg/StatusText"
        self.write(
            f"{space}/mavros/statustext/recv", kind, self.zero(kind, header=header, severity=4, text="Low"), time
        )
        kind = "sensor_msgs/msg/NavSatFix"
        fix = self.zero(kind, header=header, latitude=47.0, longitude=8.0, altitude=500.0)
        self.write(f"{space}/mavros/global_position/global", kind, fix, time)


def make(path: Path, packing: str) -> None:
    """Write two vehicles, one under a namespace; latched missions; an unknown type; diagnostics."""
    with MavrosBag(path, packing) as bag:
        for space in ("/uav0", ""):
            kind = "mavros_msgs/msg/WaypointList"
            points = [bag.zero("mavros_msgs/msg/Waypoint", x_lat=47.0 + i, frame=3) for i in range(3)]
            bag.write(f"{space}/mavros/mission/waypoints", kind, bag.zero(kind, waypoints=points), 0.0, latching=1)
        for number in range(round(SECONDS * RATE)):
            for space in ("/uav0", ""):
                bag.vehicle(space, number / RATE, number)
            if number % 50 == 0:
                part = bag.zero("acme_msgs/msg/Part", name="a", values=np.arange(3.0))
                odd = bag.zero("acme_msgs/msg/Odd", parts=[part], why="so")
                bag.write("/acme/odd", "acme_msgs/msg/Odd", odd, number / RATE)


def as_active(data: bytes) -> bytes:
    """Return a bag as it is during the recording: no index, the last chunk without its size, truncated."""
    made = bytearray(data)
    last = [found.start() for found in re.finditer(rb"op=\x05", data)][-1]
    for mark, start, size in ((b"size=", last, 13), (b"index_pos=", 0, 18), (b"conn_count=", 0, 15)):
        at = made.index(mark, start)
        made[at + len(mark) : at + size] = bytes(size - len(mark))
    end = made.index(b"op=\x04", last) - 60
    return bytes(made[:end])


def check(flight: Recording, end: float) -> None:
    assert [vehicle.name for vehicle in flight.vehicles] == ["mavros", "uav0"]
    assert len(flight.topics) == 17
    for vehicle in flight.vehicles:
        place = vehicle.position
        assert place is not None
        assert place.time[-1] > end - 0.5
        np.testing.assert_allclose(place.value, helix(place.time), atol=1e-6)  # by the stamps, not the recording times
        assert [mode for _, mode in vehicle.modes] == ["POSCTL", "OFFBOARD"]
        assert [when for when, armed in vehicle.armed if armed] == [pytest.approx(2.0)]
        assert vehicle.texts[0] == (pytest.approx(0.0), 4, "Low")
        battery = vehicle.series["battery"]
        np.testing.assert_allclose(battery.value[:, 0], 16.0 - 0.1 * battery.time, atol=1e-5)
        assert vehicle.series["setpoint"].value[0].tolist() == [VELOCITY_ALONE, 0.0, 0.0, 0.0, 1.0, 2.0, 0.5]
        assert len(vehicle.series["imu"]) > (end - 0.5) * RATE


@pytest.mark.parametrize("packing", ["", "lz4", "bz2"])
def test_bags_of_mavros_are_read_whole_and_cut_off(tmp_path: Path, packing: str) -> None:
    path = tmp_path / "real.bag"
    make(path, packing)
    flight = read_bag([path])
    assert flight.notes == []
    check(flight, SECONDS)
    active = tmp_path / "real.bag.active"
    active.write_bytes(as_active(path.read_bytes()))
    flight = read_bag([active])
    assert any("there is no index" in note for note in flight.notes)
    check(flight, SECONDS - 1.0)


def test_imu_vibration_is_shown_and_unknown_battery_values_are_not(tmp_path: Path) -> None:
    make(tmp_path / "real.bag", "lz4")
    shown = {picture.name: picture.figure for picture in pictures(read_bag([tmp_path / "real.bag"]), None)}
    for panel, expected in zip(shown["spectra"].axes, (TURNING, SHAKING), strict=True):
        assert len(panel.lines) == 2
        for found in panel.lines:
            frequency = found.get_xdata()
            assert frequency[found.get_ydata().argmax()] == pytest.approx(expected, abs=2 * frequency[0])
    assert [panel.get_ylabel() for panel in shown["batteries"].axes] == ["voltage [V]", "current [A]"]
    assert [found.get_ydata()[0] for found in shown["batteries"].axes[1].lines] == pytest.approx([12.0, 12.0])


def test_unknown_types_become_tables(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    make(tmp_path / "real.bag", "")
    assert cli.main(["convert", str(tmp_path / "real.bag"), "--to", "csv"]) == 0
    assert "Note" not in capfd.readouterr().out
    assert len(list((tmp_path / "real-csv").iterdir())) == 17
    assert '""values"": [0.0, 1.0, 2.0]' in (tmp_path / "real-csv" / "acme_odd.csv").read_text()


@pytest.mark.parametrize("own_origins", [False, True])
def test_vehicles_that_gps_alone_places_share_an_origin(tmp_path: Path, own_origins: bool) -> None:
    """The second starts 100 m north and 50 m east of the first, whether local positions share an origin or not."""
    with MavrosBag(tmp_path / "made.bag") as bag:
        kind = "sensor_msgs/msg/NavSatFix"
        for time in np.arange(0.0, 10.0, 0.1).tolist():
            for space, north, east in (("/uav0", 0.0, 0.0), ("/uav1", 100.0, 50.0)):
                degrees = np.degrees(1 / 6371008.8)
                longitude = 8.0 + (east + 2.0 * time) * degrees / np.cos(np.radians(47.0))
                latitude = 47.0 + north * degrees
                fix = bag.zero(kind, header=bag.header(time), latitude=latitude, longitude=longitude)
                bag.write(f"{space}/mavros/global_position/global", kind, fix, time)
                if own_origins:
                    bag.pose(space, (2.0 * time, 0.0, 0.0), time)
    flight = read_bag([tmp_path / "made.bag"])
    first, second = (vehicle.position.value for vehicle in flight.vehicles if vehicle.position is not None)
    if own_origins:
        (note,) = flight.notes
        assert "begin up to 112 m apart" in note
        return
    np.testing.assert_allclose(first[-1], [19.8, 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(second - first, np.tile([50.0, 100.0, 0.0], (100, 1)), atol=1e-3)
    assert flight.notes == ["positions of uav0, uav1 are from GPS, relative to the first fix of uav0"]


def poses(path: Path, spans: list[tuple[float, float]], start: float = 0.0) -> None:
    """Write a vehicle's poses in each span of time, s."""
    with Bag(path, start=start, threshold=3000) as bag:
        for number, (first, last) in enumerate(spans):
            for time in np.arange(first, last, 0.1).tolist():
                bag.pose("/iris_0", (float(number), 0.0, 0.0), time)
                bag.text("/words", "word", time)


def test_a_flight_after_time_was_set_back_is_another(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "twice.bag"
    poses(path, [(5.0, 15.0), (0.5, 20.5), (0.0, 3.0)])
    flight = read_bag([path])
    assert flight.parts == 3
    (note,) = flight.notes
    assert "3 parts (1: 5.0 to 14.9 s; 2: 0.5 to 20.4 s; 3: 0.0 to 2.9 s); part 2 is shown" in note
    for part, number, count in ((None, 1, 200), (1, 0, 100), (3, 2, 30)):
        (vehicle,) = read_bag([path], part=part).vehicles
        assert vehicle.position is not None
        assert set(vehicle.position.value[:, 0]) == {number}
        assert len(vehicle.position) == count
    assert cli.main(["analyse", str(path), "--part", "4"]) == 1
    assert "has no part 4; there are 1 to 3" in capfd.readouterr().err


def test_a_damaged_time_does_not_part_a_flight(tmp_path: Path) -> None:
    with Bag(tmp_path / "odd.bag", threshold=3000) as bag:
        for k in range(200):
            for space in ("/iris_0", "/iris_1", "/iris_2"):
                bag.pose(space, (0.0, 0.0, 0.0), 0.1 * k)
            if k == 50:
                raw = bag.store.serialize_ros1(bag.type("std_msgs/msg/String")(data="late"), "std_msgs/msg/String")
                bag.text("/words", "word", 5.0)
                bag.writer.write(bag.connections["/words", "std_msgs/msg/String"], 4_000_000_000_000_000_000, raw)
            bag.text("/words", "word", 0.1 * k)
    flight = read_bag([tmp_path / "odd.bag"])
    assert flight.parts == 1
    assert [len(vehicle.series["pose"]) for vehicle in flight.vehicles] == [200] * 3


def test_a_clock_of_dates_that_is_corrected_does_not_part_a_flight(tmp_path: Path) -> None:
    poses(tmp_path / "real.bag", [(0.0, 10.0), (5.0, 15.0)], START)
    flight = read_bag([tmp_path / "real.bag"])
    assert flight.parts == 1
    assert flight.notes == ["the recorder's clock was set back 1 times; all is shown in order of time"]
    assert len(flight.vehicles[0].series["pose"]) == 200


def test_a_search_is_no_formation_flight(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Events of a search name vehicles too, but are not read as a formation's."""
    with Bag(tmp_path / "flight.bag") as bag:
        for time in np.arange(0.0, 10.0, 0.1).tolist():
            bag.pose("/uav0", (time, 0.0, 0.0), time)
            bag.pose("/uav1", (time, 5.0, 0.0), time)
    event = {"event": "started", "time": 1.0, "vehicles": ["uav0", "uav1"]}
    (tmp_path / "events.jsonl").write_text(json.dumps(event) + "\n")
    assert cli.main(["report", str(tmp_path / "flight.bag")]) == 1
    assert "is a search's" in capfd.readouterr().err
    assert cli.main(["analyse", str(tmp_path / "flight.bag")]) == 0
    assert json.loads((tmp_path / "flight-analysis" / "report.json").read_text())["formation"] is None


def test_a_bag_written_one_topic_after_the_other_is_one_flight(tmp_path: Path) -> None:
    with Bag(tmp_path / "sorted.bag", threshold=3000) as bag:
        for space in ("/iris_0", "/iris_1"):
            for time in np.arange(0.0, 10.0, 0.1).tolist():
                bag.pose(space, (0.0, 0.0, 0.0), time)
    flight = read_bag([tmp_path / "sorted.bag"])
    assert flight.notes == []
    assert [len(vehicle.series["pose"]) for vehicle in flight.vehicles] == [100, 100]
