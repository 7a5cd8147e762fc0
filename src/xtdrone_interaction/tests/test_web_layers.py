"""Layers of the 3D view: parsing and rejection of messages, sent frames, and poses in the map frame."""

from __future__ import annotations

import math
import struct
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

pytest.importorskip("rospy")
pytest.importorskip("tf2_py")

import rospy
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Transform, TransformStamped, Vector3
from nav_msgs.msg import OccupancyGrid, Path
from sensor_msgs.msg import LaserScan, PointCloud2, PointField
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction.web.fleet.model_states_bytes import COLUMNS
from xtdrone_interaction.web.layers.frames_in_map import FramesInMap
from xtdrone_interaction.web.layers.layer_content import MOST_SIDE, UNKNOWN, Content, LayerError, Points, content_of
from xtdrone_interaction.web.layers.layer_frame import CHANNEL, pack_layer, packed_layer

STAMP = rospy.Time(10)
MOST = 1000
FIELDS = [PointField(name, 4 * n, PointField.FLOAT32, 1) for n, name in enumerate("xyz")]


def cloud_of(points: Any, **changes: Any) -> PointCloud2:
    data = np.asarray(points, "<f4").reshape(-1, 3)
    message = PointCloud2(height=1, width=len(data), fields=FIELDS, point_step=12, row_step=12 * len(data))
    message.data = data.tobytes()
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def path_of(places: Any) -> Path:
    return Path(poses=[PoseStamped(pose=Pose(position=Point(*place))) for place in places])


def grid_of(cells: Any, side: float = 0.5, turn: Quaternion | None = None) -> OccupancyGrid:
    cells = np.asarray(cells, np.int8)
    message = OccupancyGrid(data=cells.ravel().tolist())
    message.info.resolution = side
    message.info.height, message.info.width = cells.shape
    message.info.origin = Pose(Point(1.0, 2.0, 0.0), turn or Quaternion(w=1.0))
    return message


def read_as_the_page(frame: bytes) -> dict[str, Any]:
    """Return a frame's values by the offsets of the layout alone, as ``layer_frame.js`` reads them."""
    kind, number, time, n, m = *struct.unpack_from("<BxI", frame, 2), *struct.unpack_from("<dII", frame, 8)
    origin, extent = np.frombuffer(frame, "<f8", 3, 24), np.frombuffer(frame, "<f4", 3, 48)
    head = {"channel": frame[0], "version": frame[1], "kind": kind, "number": number, "time": time}
    if kind == 3:
        return {
            **head,
            "cells": np.frombuffer(frame, np.uint8, n * m, 80).reshape(m, n),
            "side": extent[0],
            "origin": origin,
            "orientation": np.frombuffer(frame, "<f4", 4, 60),
        }
    steps = np.frombuffer(frame, "<u2", 3 * n, 80).reshape(n, 3)
    return {**head, "places": origin + steps / 65535.0 * extent, "total": m}


def sent(content: Content, pose: Any = None, number: int = 7) -> dict[str, Any]:
    packed = packed_layer(content, np.eye(4) if pose is None else pose, 12.5)
    return read_as_the_page(bytes([CHANNEL]) + pack_layer(number, content, packed))


@given(
    arrays.arrays(np.float64, st.tuples(st.integers(0, 30), st.just(3)), elements=st.floats(-500.0, 500.0, width=32))
)
@settings(max_examples=40, deadline=None)
def test_points_are_sent_in_the_map_frame_to_within_their_steps(points: Any) -> None:
    turned = np.array([[0.0, -1.0, 0.0, 5.0], [1.0, 0.0, 0.0, -3.0], [0.0, 0.0, 1.0, 2.0], [0.0, 0.0, 0.0, 1.0]])
    content = content_of("sensor_msgs/PointCloud2", cloud_of(points), MOST)
    frame = sent(content, turned)
    assert (frame["channel"], frame["version"], frame["kind"], frame["number"], frame["time"]) == (3, 1, 1, 7, 12.5)
    assert frame["total"] == len(points)
    expected = np.column_stack([-points[:, 1] + 5.0, points[:, 0] - 3.0, points[:, 2] + 2.0])
    assert np.allclose(frame["places"], expected, rtol=0.0, atol=1000.0 / 65535.0)


def test_a_cloud_is_thinned_evenly_over_rings_and_columns() -> None:
    ring, column = np.meshgrid(np.arange(16), np.arange(2000))
    points = np.stack([column, ring, 0 * ring], axis=-1).reshape(-1, 3)
    content = content_of("sensor_msgs/PointCloud2", cloud_of(points), 1600)
    assert isinstance(content, Points)
    assert abs(len(content.places) - 1600) <= 2
    assert content.total == 32_000
    kept = np.bincount(content.places[:, 1].astype(int), minlength=16)
    assert kept.min() > 80  # each ring has about 100
    assert np.histogram(content.places[:, 0], 10)[0].min() > 150


def test_points_that_are_not_finite_are_left_out() -> None:
    points = [[1.0, 2.0, 3.0], [math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0], [1e30, 0.0, 0.0]]
    assert content_of("sensor_msgs/PointCloud2", cloud_of(points), MOST).places.tolist() == [[1.0, 2.0, 3.0]]  # type: ignore[union-attr]


def test_an_organised_cloud_of_another_byte_order_is_read() -> None:
    data = np.arange(12, dtype=">f4").reshape(2, 2, 3)
    message = cloud_of(data, height=2, width=2, row_step=24, is_bigendian=True, data=data.tobytes())
    assert content_of("sensor_msgs/PointCloud2", message, MOST).places.tolist() == data.reshape(-1, 3).tolist()  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"point_step": 0}, "point"),
        ({"width": 1000}, "data: 24 bytes are too few"),
        ({"width": 3_000_000}, "points: 3000000 are not allowed"),
        ({"fields": FIELDS[:2]}, "fields: z missing"),
        ({"fields": [*FIELDS[:2], PointField("z", 10, PointField.FLOAT32, 1)]}, "offset 10 is beyond point_step 12"),
        ({"height": 2, "width": 1, "row_step": 16}, "row_step: 16 is not allowed"),
    ],
)
def test_a_wrong_cloud_is_refused(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(LayerError, match=text):
        content_of("sensor_msgs/PointCloud2", cloud_of([[0.0] * 3] * 2, **changes), MOST)


def test_a_scan_has_the_returns_within_its_range() -> None:
    scan = LaserScan(angle_min=0.0, angle_increment=math.pi / 2.0, range_min=0.1, range_max=10.0)
    scan.ranges = [1.0, 2.0, math.inf, 0.05]
    content = content_of("sensor_msgs/LaserScan", scan, MOST)
    assert np.allclose(content.places, [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])  # type: ignore[union-attr]
    scan.angle_increment = math.nan
    with pytest.raises(LayerError, match="angle_increment nan"):
        content_of("sensor_msgs/LaserScan", scan, MOST)


def test_a_long_path_keeps_its_ends_and_one_with_nan_is_refused() -> None:
    places = [(float(n), 0.5, 2.0) for n in range(5001)]
    content = content_of("nav_msgs/Path", path_of(places), MOST)
    frame = sent(content)
    assert frame["kind"] == 2
    assert len(frame["places"]) <= 1001
    assert np.allclose(frame["places"][[0, -1]], [places[0], places[-1]], atol=0.1)
    assert sent(content_of("nav_msgs/Path", path_of([]), MOST))["total"] == 0
    with pytest.raises(LayerError, match=r"poses: .*nan.* is not allowed"):
        content_of("nav_msgs/Path", path_of([(0.0, 0.0, 0.0), (math.nan, 0.0, 0.0)]), MOST)


def test_a_grid_is_sent_with_its_turned_origin() -> None:
    half = math.sqrt(0.5)
    message = grid_of([[0, 100, -1], [50, 0, 0]], turn=Quaternion(z=half, w=half))
    frame = sent(content_of("nav_msgs/OccupancyGrid", message, MOST))
    assert frame["cells"].tolist() == [[0, 100, UNKNOWN], [50, 0, 0]]
    assert frame["side"] == 0.5
    assert frame["origin"].tolist() == [1.0, 2.0, 0.0]
    assert np.allclose(frame["orientation"], [half, 0.0, 0.0, half])


@given(st.integers(1, 1300), st.integers(1, 40), st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_a_large_grid_keeps_what_is_occupied(rows: int, columns: int, seed: int) -> None:
    cells = np.full((rows, columns), -1, np.int8)
    row, column = seed % rows, seed % columns
    cells[row, column] = 100
    content = content_of("nav_msgs/OccupancyGrid", grid_of(cells), MOST)
    factor = math.ceil(max(rows, columns) / MOST_SIDE)
    frame = sent(content)
    assert max(frame["cells"].shape) <= MOST_SIDE
    assert frame["side"] == 0.5 * factor
    assert np.argwhere(frame["cells"] == 100).tolist() == [[row // factor, column // factor]]
    assert np.count_nonzero(frame["cells"] != UNKNOWN) == 1


def test_a_long_narrow_grid_takes_no_more_memory_than_its_cells() -> None:
    cells = np.zeros((1, 400_000), np.int8)
    cells[0, -1] = 100
    tracemalloc.start()
    content = content_of("nav_msgs/OccupancyGrid", grid_of(cells), MOST)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert sent(content)["cells"].tolist() == [[0] * 511 + [100]]
    assert most < 40_000_000  # a square of this side would have 1.6e11 cells


@pytest.mark.parametrize("wrong", ["cells", "side", "place", "turn"])
def test_a_wrong_grid_is_refused(wrong: str) -> None:
    message = grid_of([[0, 0], [0, 0]])
    if wrong == "cells":
        message.info.width = 3
    elif wrong == "side":
        message.info.resolution = math.nan
    elif wrong == "place":
        message.info.origin.position.x = math.inf
    else:
        message.info.origin.orientation.w = math.nan
    with pytest.raises(LayerError, match="not allowed"):
        content_of("nav_msgs/OccupancyGrid", message, MOST)


# ---- frames


def row(x: float, y: float, z: float, yaw: float = 0.0) -> list[float]:
    return [x, y, z, math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw), 0.0, 0.0, 0.0]


@pytest.fixture
def frames() -> FramesInMap:
    frames = FramesInMap()
    frames.set_fleet(parse_fleet("iris_3d_lidar:2"))
    for time in (9.0, 11.0):
        frames.set_vehicles(np.array([row(time, 0.0, 3.0, math.pi / 2.0), [math.nan] * COLUMNS]), time)
    return frames


def told(parent: str, child: str, x: float, time: int = 10) -> TFMessage:
    place = Transform(Vector3(x, 0.0, 0.0), Quaternion(w=1.0))
    return TFMessage([TransformStamped(Header(stamp=rospy.Time(time), frame_id=parent), child, place)])


NAME = "iris_3d_lidar_0"
TOPIC = f"/{NAME}/velodyne_points"


@pytest.mark.parametrize("frame", ["map", "/map", "world", ""])
def test_frames_of_the_world_are_the_map_frame(frames: FramesInMap, frame: str) -> None:
    assert np.array_equal(frames.pose(frame, "/x", STAMP), np.eye(4))


def test_a_vehicle_s_sensor_is_where_the_vehicle_was(frames: FramesInMap) -> None:
    for body in (f"{NAME}/base_link", "base_link"):
        pose = frames.pose(body, TOPIC, STAMP)
        assert np.allclose(pose[:3, 3], [10.0, 0.0, 3.0])  # between the two states
        assert np.allclose(pose[:3, 0], [0.0, 1.0, 0.0])
    lidar = frames.pose(f"{NAME}/laser_3d", TOPIC, STAMP)
    assert np.allclose(lidar[:3, 3], [10.0, 0.0, 3.06])
    assert np.allclose(frames.pose(f"{NAME}/base_link", TOPIC, rospy.Time(99))[:3, 3], [11.0, 0.0, 3.0])


def test_tf_counts_more_than_the_simulator_s_poses(frames: FramesInMap) -> None:
    frames.hear_static(told("map", f"{NAME}/odom", 100.0))
    frames.hear(told(f"{NAME}/odom", f"{NAME}/base_link", 1.0))
    frames.set_vehicles(np.array([row(50.0, 0.0, 3.0), [math.nan] * COLUMNS]), 12.0)
    assert np.allclose(frames.pose(f"{NAME}/base_link", TOPIC, rospy.Time())[:3, 3], [101.0, 0.0, 0.0])
    frames.set_vehicles(np.array([row(50.0, 0.0, 3.0), [math.nan] * COLUMNS]), 1.0)  # a reset
    frames.hear(told(f"{NAME}/odom", f"{NAME}/base_link", 2.0, time=1))
    assert np.allclose(frames.pose(f"{NAME}/base_link", TOPIC, STAMP)[:3, 3], [102.0, 0.0, 0.0])


def test_new_frames_of_one_message_all_count(frames: FramesInMap) -> None:
    chain = [*told("map", "rover/odom", 1.0).transforms, *told("rover/odom", "rover/base_link", 2.0).transforms]
    frames.hear(TFMessage(chain))
    assert frames.pose("rover/base_link", "/x", STAMP)[0, 3] == 3.0


def test_an_unknown_frame_is_refused(frames: FramesInMap) -> None:
    for frame in ("nowhere", "iris_3d_lidar_1/base_link", "a frame", "a\0frame", "a\ud800frame"):
        with pytest.raises(LayerError, match=r"frame_id: .* is not allowed, one that TF connects to 'map'"):
            frames.pose(frame, "/nowhere/points", STAMP)
    frames.hear(told("map", "nowhere", math.nan))
    with pytest.raises(LayerError, match="frame_id"):
        frames.pose("nowhere", "/x", STAMP)
