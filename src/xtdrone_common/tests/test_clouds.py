"""Clouds, scans and depth images of messages as arrays."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("rospy")

import rospy
from sensor_msgs.msg import Image, LaserScan, PointCloud2, PointField

from xtdrone_common.clouds import ScanError, cloud_message, depths_of, points_of, read_cloud, read_scan


def cloud(points: np.ndarray, fields: list[PointField], step: int) -> PointCloud2:
    message = PointCloud2(height=1, width=len(points), fields=fields, point_step=step)
    message.data = points.tobytes()
    return message


def test_clouds_are_read_with_times_in_seconds_or_nanoseconds() -> None:
    kind = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
    table = np.array([(1, 2, 3, 0), (4, np.nan, 6, 5), (7, 8, 9, 50_000_000)], kind)
    fields = [PointField(axis, 4 * k, 7, 1) for k, axis in enumerate("xyz")] + [PointField("t", 12, 6, 1)]
    scan = read_cloud(cloud(table, fields, 16))
    assert scan.points.tolist() == [[1, 2, 3], [7, 8, 9]]
    assert scan.times.tolist() == [0.0, 0.05]
    fields[3] = PointField("time", 12, 7, 1)
    table = table.astype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<f4")])
    table["t"] = [0.0, 0.01, 0.02]
    assert read_cloud(cloud(table, fields, 16)).times == pytest.approx([0.0, 0.02])


def test_clouds_that_cannot_be_read_are_named() -> None:
    fields = [PointField(axis, 4 * k, 7, 1) for k, axis in enumerate("xy")]
    with pytest.raises(ValueError, match="fields: z missing among x, y"):
        read_cloud(cloud(np.zeros((2, 2), "<f4"), fields, 8))
    message = cloud(np.zeros((2, 2), "<f4"), fields, 8)
    message.width = 9
    with pytest.raises(ValueError, match="data: 16 bytes are too few for 9 points of 8"):
        read_cloud(message)
    fields.append(PointField("z", 8, 7, 1))
    with pytest.raises(ValueError, match="field z: offset 8 is beyond point_step 8"):
        read_cloud(cloud(np.zeros((2, 2), "<f4"), fields, 8))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"offset": 10}, "field z: offset 10 is beyond point_step 12"),
        ({"datatype": 9}, "fields: z missing"),
        ({"count": 2}, "fields: z missing"),
        ({"name": "w"}, "fields: z missing among x, y, w"),
    ],
)
def test_a_cloud_whose_fields_cannot_be_read_is_refused(changes: dict, text: str) -> None:
    fields = [PointField(name, 4 * k, PointField.FLOAT32, 1) for k, name in enumerate("xyz")]
    message = cloud(np.arange(6, dtype="<f4").reshape(2, 3), fields, 12)
    assert points_of(message)["z"].tolist() == [2.0, 5.0]
    for name, value in changes.items():
        setattr(fields[2], name, value)
    with pytest.raises(ScanError, match=text):
        points_of(message)


def test_numbers_of_either_byte_order_are_read() -> None:
    fields = [PointField(name, 4 * k, PointField.FLOAT32, 1) for k, name in enumerate("xyz")]
    message = cloud(np.arange(6, dtype=">f4").reshape(2, 3), fields, 12)
    message.is_bigendian = True
    assert read_cloud(message).points.tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]


def test_points_of_a_message_are_those_that_it_was_made_of() -> None:
    points = np.random.default_rng(1).normal(size=(20, 3))
    message = cloud_message(points, rospy.Time(3), "map")
    assert (message.header.stamp.secs, message.header.frame_id, message.row_step) == (3, "map", 240)
    assert read_cloud(message).points == pytest.approx(points, abs=1e-6)


def test_a_scan_has_the_returns_within_its_range() -> None:
    ranges = [1.0, math.inf, 2.0, 0.01, 99.0]
    scan = read_scan(_scan(ranges))
    assert scan.points == pytest.approx(np.array([[1.0, 0.0], [2.0 * math.cos(1.0), 2.0 * math.sin(1.0)]]))
    assert scan.times == pytest.approx([0.0, 0.2])
    assert scan.duration == pytest.approx(0.4)
    with pytest.raises(ScanError, match="ranges: 1 are not allowed"):
        read_scan(_scan([1.0]))


def _scan(ranges: list[float]) -> LaserScan:
    return LaserScan(angle_increment=0.5, time_increment=0.1, range_min=0.2, range_max=30.0, ranges=ranges)


def test_depths_are_in_metres_and_unknown_where_there_are_none() -> None:
    for encoding, kind, unit in (("32FC1", "<f4", 1.0), ("16UC1", "<u2", 1000.0)):
        values = (np.array([[1.0, 0.0], [3.0, 4.0]]) * unit).astype(kind)
        image = Image(height=2, width=2, encoding=encoding, step=2 * values.itemsize, data=values.tobytes())
        assert depths_of(image).tolist()[1] == pytest.approx([3.0, 4.0])
        assert math.isnan(depths_of(image, np.float32)[0, 1])
    with pytest.raises(ScanError, match="encoding: 'rgb8'"):
        depths_of(Image(encoding="rgb8"))
    image.step = 3
    with pytest.raises(ScanError, match="2 x 2 px in rows of 3 bytes, but 8 bytes"):
        depths_of(image)
