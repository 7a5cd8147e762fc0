"""The gimbal node with a real master in lockstep; run as a program, this file is a moving vehicle and a recorder."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import pytest
from test_yolo_node import PATIENCE, Stack, rospy

import xtdrone_lockstep as lockstep
from xtdrone_common.cameras.camera_pose import camera_link_pose, mount_orientation
from xtdrone_common.frames import to_xyzw

if rospy is not None:
    from gazebo_msgs.msg import LinkStates
    from geometry_msgs.msg import Pose, PoseStamped, Quaternion, Twist, Vector3
    from mavros_msgs.msg import MountControl

pytestmark = pytest.mark.skipif(rospy is None, reason="needs ROS 1 and the built workspace")

NODE = str(Path(__file__).parents[1] / "nodes" / "gimbal_control.py")
MOUNT = mount_orientation(0.0, -1.0, 0.3)
HEADING = (math.cos(0.25), 0.0, 0.0, math.sin(0.25))  # 0.5 rad from east
TRUE = (7.0, 8.0, 9.0)


def place_at(seconds: float) -> tuple[float, float, float]:
    return 2.0 * seconds, 1.0, 20.0


def vehicle(file: str) -> None:
    """Simulate vehicle 1 of the fleet: moves, commands its gimbal at 1 s and, with invalid angles, at 2 s; records."""
    lockstep.init_node("vehicle", rate=30.0)
    out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process
    pose = lockstep.Publisher("/typhoon_h480_1/mavros/local_position/pose", PoseStamped)
    mount = lockstep.Publisher("/typhoon_h480_1/mavros/mount_control/orientation", Quaternion)
    steer = lockstep.Publisher("/xtdrone/typhoon_h480_1/gimbal_cmd", Vector3)
    links = lockstep.Publisher("/gazebo/link_states", LinkStates)

    def note(topic: str, **values: object) -> None:
        print(json.dumps({"now": rospy.get_time(), "topic": topic, **values}), file=out)

    def on_command(m: MountControl) -> None:
        note("command", mode=m.mode, angles=[m.roll, m.pitch, m.yaw])

    def on_pose(m: PoseStamped) -> None:
        p, q = m.pose.position, m.pose.orientation
        note("pose", stamp=m.header.stamp.to_sec(), frame=m.header.frame_id, pose=[p.x, p.y, p.z, q.x, q.y, q.z, q.w])

    def step() -> None:
        message = PoseStamped()
        message.header.stamp = rospy.Time.now()
        p, q = message.pose.position, message.pose.orientation
        p.x, p.y, p.z = place_at(message.header.stamp.to_sec())
        q.w, q.x, q.y, q.z = HEADING
        pose.publish(message)
        mount.publish(Quaternion(*to_xyzw(MOUNT)))
        true = Pose()
        true.position.x, true.position.y, true.position.z = TRUE
        true.orientation.w = 1.0
        links.publish(LinkStates(["typhoon_h480_1::cgo3_camera_link"], [true], [Twist()]))
        turn = round(message.header.stamp.to_sec() * 30.0)
        if turn in (30, 60):
            steer.publish(Vector3(1.0, -90.0, 45.0) if turn == 30 else Vector3(math.nan, 200.0, 0.0))

    keep = [
        lockstep.Subscriber("/typhoon_h480_1/mavros/mount_control/command", MountControl, on_command),
        lockstep.Subscriber("/xtdrone/typhoon_h480_1/cam_pose", PoseStamped, on_pose),
    ]
    lockstep.start()
    lockstep.spin(step)
    del keep


@pytest.fixture
def stack(tmp_path):
    stack = Stack(tmp_path)
    stack.set("/xtdrone/fleet", "typhoon_h480:2")
    yield stack
    stack.stop()


def fly(stack: Stack, seconds: float) -> tuple[list[dict], list[dict]]:
    """Return the commands and the poses that the vehicle has received."""
    stack.start("vehicle", sys.executable, __file__, "vehicle", str(stack.folder / "record"))
    stack.start("gimbal", sys.executable, NODE, "typhoon_h480", "all", "__name:=gimbal")
    names = ["/gimbal", "/vehicle"]
    assert stack.server.wait_for(names, timeout=PATIENCE), (stack.server.missing(names), stack.output("gimbal"))
    now = stack.server.next_due_us(-1)
    while now is not None and now < seconds * 1e6:
        stack.server.tick(now)
        now = stack.server.next_due_us(now)
    assert now is not None, stack.output("gimbal")
    lines = stack.lines()
    return [line for line in lines if line["topic"] == "command"], [line for line in lines if line["topic"] == "pose"]


def test_the_gimbal_is_commanded_and_the_camera_pose_published(stack):
    commands, poses = fly(stack, 3.0)
    assert {line["mode"] for line in commands} == {2}
    assert [line["angles"] for line in commands if line["now"] < 1.0][-1] == [0.0, -60.0, 0.0]
    assert {tuple(line["angles"]) for line in commands if line["now"] > 1.2} == {(1.0, -90.0, 45.0)}
    assert len(commands) == pytest.approx(90, abs=3)
    assert len(poses) == pytest.approx(90, abs=4)
    for line in poses:
        wanted = camera_link_pose(place_at(line["stamp"]), HEADING, MOUNT, (0.041, 0.0, -0.122))
        assert line["pose"] == pytest.approx([*wanted.position, *to_xyzw(wanted.orientation)], abs=1e-9)
        assert line["frame"] == "map"
    assert "gimbal_cmd: (nan, 200.0, 0.0) is not allowed, -180 to 180 deg each" in stack.output("gimbal")


def test_true_poses_and_other_angles_by_parameters(stack):
    stack.set("/gimbal/source", "gazebo")
    stack.set("/gimbal/pitch", -30.0)
    commands, poses = fly(stack, 0.5)
    assert commands[0]["angles"] == [0.0, -30.0, 0.0]
    assert poses[-1]["pose"] == [*TRUE, 0.0, 0.0, 0.0, 1.0]


def test_invalid_parameters_are_reported(stack):
    wrong = [
        ("pitch", -200.0, "/pitch: -200.0 is not allowed, -180 to 180 deg"),
        ("source", "eyes", "/source: 'eyes' is not allowed, vehicle or gazebo"),
        ("camera_offset", [1.0], "/camera_offset: [1.0] is not allowed, 3 numbers, -10 to 10 m"),
    ]
    stack.master.deleteParam("/test", "/lockstep/uri")
    for name, value, _ in wrong:
        stack.set(f"/{name}/{name}", value)
        stack.start(name, sys.executable, NODE, "typhoon_h480", "0", f"__name:={name}")
    for name, _, message in wrong:
        assert stack.processes[name].wait(PATIENCE) == 2, stack.output(name)
        assert message in stack.output(name)
        assert "Traceback" not in stack.output(name)


if __name__ == "__main__":
    vehicle(sys.argv[2])
