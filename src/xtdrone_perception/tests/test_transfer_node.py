"""The node that forwards poses of programs of others, with sources on /tf whose transforms have no time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rospy")

import rospy
from geometry_msgs.msg import PoseStamped, Quaternion, Transform, TransformStamped, Vector3
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

import xtdrone_lockstep as lockstep
from xtdrone_perception.slam.transfer.foreign_pose import PlaceSettings
from xtdrone_perception.slam.transfer.transfer_node import SOURCES, ForeignOptions, PoseTransfer

VISION, REPORTS = "/iris_0/mavros/vision_pose/pose", "/diagnostics"
TURN = 1.0 / 60.0  # s


class Topics:
    """Topics of this test in place of those of a master."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sent: dict[str, list[Any]] = {}
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.now = 0.0
        monkeypatch.setattr(lockstep, "Publisher", self._publisher, raising=False)
        monkeypatch.setattr(lockstep, "Subscriber", self._subscriber, raising=False)
        monkeypatch.setattr(lockstep, "add_reset_hook", lambda hook: None, raising=False)
        monkeypatch.setattr(rospy.Time, "now", lambda: rospy.Time.from_sec(self.now))
        monkeypatch.setattr(rospy, "get_time", lambda: self.now)

    def _subscriber(self, topic: str, kind: type, callback: Callable[[Any], None], **_: Any) -> None:
        self.callbacks[topic] = callback

    def _publisher(self, topic: str, kind: type, **_: Any) -> Any:
        sent = self.sent.setdefault(topic, [])
        return type("Publisher", (), {"publish": lambda _, m: sent.append(m), "get_num_connections": lambda _: 0})()

    def link(self, topic: str, parent: str, child: str, x: float, stamp: float = 0.0) -> None:
        header = Header(stamp=rospy.Time.from_sec(stamp), frame_id=parent)
        transform = Transform(Vector3(x, 0.0, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))
        self.callbacks[topic](TFMessage([TransformStamped(header, child, transform)]))

    @property
    def poses(self) -> list[tuple[float, float]]:
        """Times and x, m, of the poses for the autopilot."""
        found: list[PoseStamped] = self.sent[VISION]
        return [(m.header.stamp.to_sec(), m.pose.position.x) for m in found]


def test_transforms_without_a_time_are_of_now_and_static_ones_alone_are_no_pose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    topics = Topics(monkeypatch)
    node = PoseTransfer("iris_0", SOURCES["aloam"], ForeignOptions(topic="world aft_mapped"), PlaceSettings())

    def turn() -> None:
        topics.now += TURN
        node.step()

    topics.link("/tf_static", "world", "camera_init", 10.0, stamp=0.5)
    topics.link("/tf", "elsewhere", "another", 0.0)
    turn()
    assert topics.poses == []
    for x in (1.0, 2.0, 2.0, 3.0):  # the third is a repetition
        topics.link("/tf", "camera_init", "aft_mapped", x)
        topics.link("/tf", "elsewhere", "another", x)
        turn()
    assert np.allclose(topics.poses, [(2 * TURN, 11.0), (3 * TURN, 12.0), (5 * TURN, 13.0)])
    topics.link("/tf", "camera_init", "aft_mapped", 4.0, stamp=0.07)
    turn()
    assert topics.poses[-1] == (0.07, 14.0)
    for _ in range(70):  # it repeats its last pose only
        topics.link("/tf", "camera_init", "aft_mapped", 4.0, stamp=0.07)
        turn()
    assert len(topics.poses) == 4
    assert topics.sent[REPORTS][-1].status[0].message == "no new poses for 1 s"
