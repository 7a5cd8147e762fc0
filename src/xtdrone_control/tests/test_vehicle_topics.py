"""A vehicle's topics in one place: what is stored, what is ignored, and what a reset forgets."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("rospy")

import rospy
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Twist, TwistStamped, Vector3
from mavros_msgs.msg import ExtendedState, State
from nav_msgs.msg import Odometry
from std_msgs.msg import Header

import xtdrone_lockstep as lockstep
from xtdrone_common.pose_history import PoseHistory
from xtdrone_control.vehicle_topics import VehicleReport, VehicleTopics

MAVROS = "/iris_0/mavros"


class Topics:
    """Topics of this test in place of those of a master."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.hooks: list[Callable[[], None]] = []
        self.sent: list[Any] = []
        sent = self.sent
        publisher = type("Publisher", (), {"publish": lambda _, message: sent.append(message)})
        monkeypatch.setattr(lockstep, "Subscriber", lambda topic, kind, call: self.callbacks.update({topic: call}))
        monkeypatch.setattr(lockstep, "Publisher", lambda topic, kind: publisher())
        monkeypatch.setattr(lockstep, "add_reset_hook", self.hooks.append)
        monkeypatch.setattr(rospy, "get_time", lambda: 7.0)


@pytest.fixture
def topics(monkeypatch: pytest.MonkeyPatch) -> Topics:
    return Topics(monkeypatch)


def pose(x: float, time: float = 0.0, w: float = 1.0) -> PoseStamped:
    header = Header(stamp=rospy.Time.from_sec(time))
    return PoseStamped(header, Pose(Point(x, 2.0, 3.0), Quaternion(0.0, 0.0, 0.0, w)))


def test_topics_are_subscribed_in_the_order_of_their_names(topics: Topics) -> None:
    VehicleTopics("iris_0", "state", "pose", "extended_state", "velocity")
    assert list(topics.callbacks) == [
        f"{MAVROS}/state", f"{MAVROS}/local_position/pose", f"{MAVROS}/extended_state",
        f"{MAVROS}/local_position/velocity_local",
    ]  # fmt: skip


def test_the_latest_pose_is_kept_and_invalid_ones_are_ignored(topics: Topics) -> None:
    history, seen = PoseHistory(), []
    vehicle = VehicleTopics("iris_0", "pose", poses=history, on_pose=lambda stamp, entry: seen.append(stamp.to_sec()))
    assert vehicle.recent_pose(0.0, 1.0) is None
    send = topics.callbacks[f"{MAVROS}/local_position/pose"]
    for message in (pose(1.0, 5.0), pose(math.nan, 6.0), pose(4.0, 6.0, w=0.5)):
        send(message)
    assert vehicle.pose is not None
    assert vehicle.pose.tolist() == [1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]
    assert vehicle.recent_pose(5.5, 0.5) is vehicle.pose
    assert vehicle.recent_pose(5.6, 0.5) is None
    assert history.last is vehicle.pose
    assert seen == [5.0]
    for hook in topics.hooks:
        hook()
    assert vehicle.pose is None
    assert history.last is None


def test_poses_may_be_those_of_an_odometry(topics: Topics) -> None:
    vehicle = VehicleTopics("iris_0", "pose", odometry="slam")
    message = Odometry()
    message.pose.pose = pose(8.0).pose
    topics.callbacks["/iris_0/slam/odometry"](message)
    assert vehicle.pose is not None
    assert vehicle.pose[0] == 8.0


def test_velocity_and_states_are_kept(topics: Topics) -> None:
    vehicle = VehicleTopics("iris_0", "velocity", "state", "extended_state")
    send = topics.callbacks[f"{MAVROS}/local_position/velocity_local"]
    send(TwistStamped(twist=Twist(linear=Vector3(1.0, 2.0, 3.0))))
    send(TwistStamped(twist=Twist(linear=Vector3(math.inf, 2.0, 3.0))))
    assert (vehicle.velocity.tolist(), vehicle.heard) == ([1.0, 2.0, 3.0], 7.0)
    topics.callbacks[f"{MAVROS}/state"](State(armed=False, mode="OFFBOARD"))
    assert (vehicle.armed, vehicle.is_offboard) == (False, False)
    topics.callbacks[f"{MAVROS}/state"](State(armed=True, mode="OFFBOARD"))
    assert (vehicle.armed, vehicle.is_offboard) == (True, True)
    assert (vehicle.is_in_air, vehicle.is_on_ground) == (False, False)
    topics.callbacks[f"{MAVROS}/extended_state"](ExtendedState(landed_state=ExtendedState.LANDED_STATE_IN_AIR))
    assert (vehicle.is_in_air, vehicle.is_on_ground) == (True, False)
    topics.hooks[0]()
    assert not vehicle.armed
    assert vehicle.velocity.tolist() == [0.0, 0.0, 0.0]


def test_a_report_is_published_on_change_and_once_a_second(topics: Topics) -> None:
    report = VehicleReport("iris_0", "planner")
    changes = []
    for k, (level, kind) in enumerate([(0, "a"), (0, "a"), (1, "a"), (1, "b"), (1, "b"), (1, "b")]):
        changes.append(report.publish(rospy.Time.from_sec(1.0 + 0.4 * k), level, f"text {k}", {"n": str(k)}, kind))
    assert changes == [True, False, True, True, False, False]
    statuses = [message.status[0] for message in topics.sent]
    assert [status.message for status in statuses] == ["text 0", "text 2", "text 3"]
    report.publish(rospy.Time.from_sec(3.3), 1, "later", {}, "b")
    status = topics.sent[-1].status[0]
    assert (status.name, status.hardware_id, status.message) == ("iris_0: planner", "iris_0", "later")
    assert report.level == 1
