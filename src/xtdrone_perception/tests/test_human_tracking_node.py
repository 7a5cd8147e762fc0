"""The following node with a real master in lockstep; run as a program, this file is the vehicle it commands."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from perception_stack import PATIENCE, Stack

import xtdrone_lockstep as lockstep

try:
    import rospy
    from geometry_msgs.msg import Point, PoseStamped, Twist, Vector3
    from mavros_msgs.msg import MountControl
    from std_msgs.msg import Int32, String
    from xtdrone_msgs.msg import ObjectOnGround, ObjectsOnGround
except ImportError:
    rospy = None

pytestmark = pytest.mark.skipif(rospy is None, reason="needs ROS 1 and the built workspace")

NODE = Path(__file__).parents[1] / "nodes" / "yolo_human_tracking.py"
NAME = "typhoon_h480_0"
PERSON = (20.0, 5.0)


def stage(file: str) -> None:
    """Simulate a vehicle that hovers at 15 m and sees track 3 from 1 s to 4 s, named at 2 s; record its commands."""
    lockstep.init_node("stage", rate=30.0)
    out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process

    def note(topic: str, *values: object) -> None:
        print(json.dumps([rospy.get_time(), topic, *values]), file=out)

    pose = lockstep.Publisher(f"/{NAME}/mavros/local_position/pose", PoseStamped)
    objects = lockstep.Publisher(f"/xtdrone/{NAME}/objects", ObjectsOnGround)
    follow = lockstep.Publisher(f"/xtdrone/{NAME}/follow", Int32)
    keep = [
        lockstep.Subscriber(
            f"/xtdrone/{NAME}/cmd_vel_flu",
            Twist,
            lambda m: note("vel", m.linear.x, m.linear.y, m.linear.z, m.angular.z),
        ),
        lockstep.Subscriber(f"/xtdrone/{NAME}/cmd", String, lambda m: note("cmd", m.data)),
        lockstep.Subscriber(f"/xtdrone/{NAME}/follow_state", String, lambda m: note("state", m.data)),
        lockstep.Subscriber(
            f"/{NAME}/mavros/mount_control/command", MountControl, lambda m: note("mount", m.mode, m.pitch, m.yaw)
        ),
    ]

    def step() -> None:
        now = rospy.Time.now()
        turn = round(now.to_sec() * 30.0)
        message = PoseStamped()
        message.header.stamp = now
        message.pose.position.z = 15.0
        message.pose.orientation.w = 1.0
        pose.publish(message)
        if turn == 60:
            follow.publish(Int32(3))
        if turn == 270:
            follow.publish(Int32(-1))
        if turn % 15 == 0 and 30 <= turn < 120:
            found = ObjectsOnGround(vehicle=NAME)
            found.header.stamp = now
            entry = ObjectOnGround(id=3, object_class="human", probability=0.9, hits=5)
            entry.position, entry.velocity = Point(*PERSON, 0.0), Vector3(0.5, 0.0, 0.0)
            other = ObjectOnGround(id=1, object_class="human", probability=0.0, position=Point(1.0, 0.0, 0.0))
            found.objects = [other, entry]
            objects.publish(found)

    lockstep.start()
    lockstep.spin(step)
    del keep


@pytest.fixture
def stack(tmp_path: Path) -> Iterator[Stack]:
    stack = Stack(tmp_path)
    yield stack
    stack.stop()


def test_follows_the_named_track_until_the_loss_and_until_the_stop(stack):
    stack.set("/tracker/wait", True)
    stack.set("/tracker/max_speed", 10.0)
    stack.start("stage", sys.executable, __file__, str(stack.record))
    stack.start("tracker", sys.executable, str(NODE), "typhoon_h480", "0", "__name:=tracker")
    stack.wait_for("/stage", "/tracker")
    stack.run(10.0)
    lines = stack.lines()
    said = [(line[1], line[2]) for line in lines if line[1] in ("cmd", "state")]
    assert said == [
        ("state", "idle"),
        ("cmd", "OFFBOARD"),
        ("state", "following"),
        ("cmd", "HOVER"),
        ("state", "searching"),
        ("cmd", "HOVER"),
        ("state", "idle"),
    ]
    velocities = [line for line in lines if line[1] == "vel"]
    first = velocities[0]
    assert 2.0 < first[0] < 2.7  # the first picture after the track was named
    away = math.hypot(*PERSON)
    pull = 0.5 * (away - 10.0)
    assert first[2] == pytest.approx(pull * PERSON[0] / away + 0.5, abs=0.1)
    assert first[3] == pytest.approx(pull * PERSON[1] / away, abs=0.1)
    assert first[4] == pytest.approx(0.0, abs=1e-6)
    assert 0.1 < first[5] < 0.5  # turns left, towards the person
    hovered = [line[0] for line in lines if line[1:3] == ["cmd", "HOVER"]]
    assert hovered[0] == pytest.approx(3.5 + 2.0, abs=0.15)
    assert not [line for line in velocities if hovered[0] < line[0] < hovered[0] + 0.9]
    rising = [line for line in velocities if line[0] > hovered[0] + 0.9]
    assert rising
    assert {tuple(line[2:]) for line in rising} == {(0.0, 0.0, 0.5, 0.0)}
    assert max(line[0] for line in velocities) <= hovered[1] + 0.1
    mounts = [line for line in lines if line[1] == "mount"]
    assert mounts[0][2:] == pytest.approx([2, math.degrees(-math.atan2(14.15, away)), 0.0], abs=1.0)
    assert all(late[0] - early[0] > 0.19 for early, late in pairwise(mounts))

    stack.end("tracker")


def test_an_invalid_parameter_is_reported(stack):
    stack.master.deleteParam("/test", "/lockstep/uri")
    stack.set("/tracker/height", 1.0)
    process = stack.start("tracker", sys.executable, str(NODE), "typhoon_h480", "0", "__name:=tracker")
    assert process.wait(PATIENCE) == 2, stack.outputs()
    assert "/tracker/height: 1.0 is not allowed, 2 to 200 m" in stack.output("tracker")


if __name__ == "__main__":
    stage(sys.argv[1])
