"""map_merging.py with a real master in lockstep: three vehicles with synthetic maps, the third in another yard.

Run as a program, this file is one of the other nodes: ``fleet`` (the vehicles) or ``recorder``.
"""

from __future__ import annotations

import json
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from perception_stack import Stack
from scipy.spatial.transform import Rotation
from toy_yard import seen, way, yard

import xtdrone_lockstep as lockstep
from xtdrone_common.clouds import cloud_message, read_cloud
from xtdrone_common.pose_matrices import inverse, pose_of, transform_points, turned_about_z
from xtdrone_common.pose_messages import pose_message, stamped_pose
from xtdrone_planning.octree.octree_format import read_file

try:
    import rospy
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseStamped
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import PointCloud2
    from tf2_msgs.msg import TFMessage
except ImportError:
    rospy = None

pytestmark = pytest.mark.skipif(rospy is None, reason="needs ROS 1 and the built workspace")

NODE = Path(__file__).parents[1] / "nodes" / "map_merging.py"
NAMES = ["iris_0", "iris_1", "iris_2"]
FRAMES = [
    pose_of(place, turned_about_z(heading))
    for place, heading in (((1.0, -2.0, 0.0), 0.0), ((12.0, 7.0, 0.5), 2.4), ((3.0, 1.0, 0.3), 0.1))
]
LIMITS = [(0.0, 25.0), (15.0, 40.0), (0.0, 25.0)]  # m, seen by each vehicle
SEEDS = [0, 0, 50]  # of the yards that they are in
NOISE = 0.15  # m


def fleet() -> None:
    """Publish poses, maps and, of the first vehicle, estimates of the others."""
    lockstep.init_node("fleet", rate=20.0)
    poses = [lockstep.Publisher(f"/{name}/mavros/local_position/pose", PoseStamped) for name in NAMES]
    maps = [lockstep.Publisher(f"/{name}/octomap_point_cloud_centers", PointCloud2, latch=True) for name in NAMES]
    estimates = [lockstep.Publisher(f"/xtdrone/{NAMES[0]}/neighbours/{name}", Odometry) for name in NAMES]
    clouds = [seen(yard(SEEDS[k]), LIMITS[k], FRAMES[k], k) for k in range(3)]

    def step() -> None:
        now = rospy.Time.now()
        turn = round(20.0 * now.to_sec())
        places = [way(k, np.array([4.0 * now.to_sec()]))[0] for k in range(3)]
        for k in range(3):
            own = transform_points(inverse(FRAMES[k]), places[k])
            poses[k].publish(stamped_pose(pose_of(own, Rotation.identity()), now, "map"))
            if turn == 20 * (k + 1):
                maps[k].publish(cloud_message(clouds[k], now, "map"))
        if turn == 160:  # a map without heights
            wrong = cloud_message(clouds[1], now, "map")
            wrong.fields = wrong.fields[:2]
            maps[1].publish(wrong)
        rng = np.random.default_rng(turn)
        for k in (1, 2):
            message = Odometry()
            message.header.stamp = now
            relative = (places[k] - places[0]) @ FRAMES[0][:3, :3] + NOISE * rng.standard_normal(3)
            if turn % 50 == 7:
                relative += [np.nan, 0.0, 0.0]
            message.pose.pose = pose_message(pose_of(relative, Rotation.identity()))
            message.pose.covariance = np.diag([NOISE**2] * 6).ravel().tolist()
            estimates[k].publish(message)

    lockstep.start()
    lockstep.spin(step)


def recorder(file: str) -> None:
    """Record the node's messages, one JSON line each."""
    lockstep.init_node("recorder", rate=20.0)
    out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process

    def note(topic: str, **values: object) -> None:
        print(json.dumps({"now": rospy.get_time(), "topic": topic, **values}), file=out)

    def on_map(message: PointCloud2) -> None:
        note("map", frame=message.header.frame_id, digest=zlib.crc32(message.data))
        np.save(f"{file}.npy", read_cloud(message).points)

    def on_tf(message: TFMessage) -> None:
        for entry in message.transforms:
            t, q = entry.transform.translation, entry.transform.rotation
            pose = [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
            note("tf", parent=entry.header.frame_id, child=entry.child_frame_id, pose=pose)

    def on_state(message: DiagnosticArray) -> None:
        states = {s.hardware_id: [s.level, s.message, {v.key: v.value for v in s.values}] for s in message.status}
        note("state", states=states)

    keep = [
        lockstep.Subscriber("/xtdrone/merged_map", PointCloud2, on_map),
        lockstep.Subscriber("/tf", TFMessage, on_tf),
        lockstep.Subscriber("/diagnostics", DiagnosticArray, on_state),
    ]
    lockstep.add_reset_hook(lambda: note("back"))
    lockstep.start()
    lockstep.spin()
    del keep


@pytest.fixture
def stack(tmp_path: Path) -> Iterator[Stack]:
    stack = Stack(tmp_path)
    yield stack
    stack.stop()


def test_maps_are_merged_where_they_fit_and_alike_after_a_reset(stack: Stack, tmp_path: Path) -> None:
    stack.set("/map_merging/period", 4.0)
    stack.set("/map_merging/heading_deviation", 3.2)
    stack.set("/map_merging/file", str(tmp_path / "merged.bt"))
    stack.start("recorder", sys.executable, __file__, "recorder", str(stack.record))
    stack.start("fleet", sys.executable, __file__, "fleet")
    stack.start("map_merging", sys.executable, str(NODE), "iris", "0-2")
    stack.wait_for("/fleet", "/recorder", "/map_merging")
    stack.run(18.0)
    stack.server.reset_time(0)
    stack.run(18.0)
    records = stack.lines()
    back = next(i for i, line in enumerate(records) if line["topic"] == "back")
    first = records[:back]
    assert first == records[back + 1 :]

    states = [line["states"] for line in first if line["topic"] == "state"]
    assert [states[0][name][0] for name in NAMES] == [1, 1, 1]
    assert states[0][NAMES[1]][1] == "not merged: no map has been received"
    last = states[-1]
    assert last[NAMES[0]][:2] == [0, "reference frame; 2 maps are merged"]
    assert last[NAMES[1]][0] == 0
    assert last[NAMES[1]][1].startswith(f"merged through that of {NAMES[0]}, residual 0.")
    assert float(last[NAMES[1]][2]["residual, m"]) < 0.13  # voxels of 0.2 m
    assert float(last[NAMES[1]][2]["overlap"]) > 0.2
    assert last[NAMES[2]][0] == 1
    assert last[NAMES[2]][1].startswith(f"not merged: with {NAMES[0]}: ")
    assert "its map was rejected: fields: z missing" in stack.output("map_merging")

    (*_, found) = [line for line in first if line["topic"] == "tf" and line["child"] == f"{NAMES[1]}/map"]
    assert found["parent"] == "map"
    pose = pose_of(found["pose"][:3], Rotation.from_quat(found["pose"][3:]))
    place = transform_points(inverse(FRAMES[1]), np.array([[20.0, 10.0, 1.0]]))
    true = inverse(FRAMES[0]) @ FRAMES[1]
    assert np.linalg.norm(transform_points(pose, place) - transform_points(true, place)) < 0.1
    assert not [line for line in first if line["topic"] == "tf" and line["child"] == f"{NAMES[2]}/map"]

    maps = [line for line in first if line["topic"] == "map"]
    assert {line["frame"] for line in maps} == {"map"}
    points = transform_points(FRAMES[0], np.load(f"{stack.record}.npy"))
    assert points[:, 0].max() > 39.0
    assert points[:, 0].min() < 1.0
    stack.end("map_merging")
    saved = transform_points(FRAMES[0], read_file(tmp_path / "merged.bt").middles())
    assert abs(len(saved) - len(points)) < 0.05 * len(points)  # merged once more at the end
    assert saved[:, 0].max() > 39.0
    assert saved[:, 0].min() < 1.0


def test_one_vehicle_is_refused(stack: Stack) -> None:
    stack.start("map_merging", sys.executable, str(NODE), "iris", "0")
    assert stack.processes["map_merging"].wait(60.0) == 2
    assert "id: 1 vehicle is not allowed, at least 2" in stack.output("map_merging")


if __name__ == "__main__":
    {"fleet": fleet, "recorder": recorder}[sys.argv[1]](*sys.argv[2:])
