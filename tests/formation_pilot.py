"""A lockstep participant for tests: flies three vehicles into a formation, the same way after every reset.

It publishes on ``/pilot/flight`` (String, JSON) a checksum of the true motion of all vehicles and of all messages of
leader, followers and avoidance in the first 15.5 s, each with its time.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
from functools import partial
from typing import Any

import rospy
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Pose, Twist, Vector3
from std_msgs.msg import Float32MultiArray, Int32MultiArray, String

import xtdrone_lockstep as lockstep

RATE = 30.0
COUNT = 3
LEADER = "/xtdrone/leader"


class Pilot:
    def __init__(self) -> None:
        self._flight = lockstep.Publisher("/pilot/flight", String, latch=True)
        self._pattern = lockstep.Publisher(f"{LEADER}/cmd", String)
        self._course = lockstep.Publisher(f"{LEADER}/cmd_vel_flu", Twist)
        self._commands = [lockstep.Publisher(f"/xtdrone/iris_{i}/cmd", String) for i in range(COUNT)]
        self._poses = [lockstep.Publisher(f"/xtdrone/iris_{i}/cmd_pose_enu", Pose) for i in range(COUNT)]
        self._hear("/gazebo/model_states", ModelStates)
        self._hear("/xtdrone/formation_pattern", Float32MultiArray)
        self._hear("/xtdrone/communication_topology", Int32MultiArray)
        for i in range(COUNT):
            self._hear(f"/xtdrone/iris_{i}/avoid_vel", Vector3)
        for i in range(1, COUNT):
            self._hear(f"/xtdrone/iris_{i}/cmd_vel_enu", Twist)
        lockstep.add_reset_hook(self._begin)
        self._begin()

    def _hear(self, topic: str, kind: type) -> None:
        lockstep.Subscriber(topic, kind, partial(self._take, topic))

    def _begin(self) -> None:
        self._turn = 0
        self._sums: dict[str, Any] = {}
        self._counts: dict[str, int] = {}
        self._states: Any = None
        self._offsets: list[float] = []

    def _take(self, topic: str, message: Any) -> None:
        latched = topic.endswith(("pattern", "topology"))
        # latched ones from before the reset arrive in the first turn after it, and then empty ones withdraw them
        if latched and (self._turn == 0 or not message.data):
            return
        if topic.endswith("states"):
            self._states = message
        elif topic.endswith("pattern"):
            self._offsets = list(message.data)
        content = io.BytesIO()
        message.serialize(content)
        total = self._sums.setdefault(topic, hashlib.sha256())
        total.update(f"{rospy.get_time()}".encode() + content.getvalue())
        self._counts[topic] = self._counts.get(topic, 0) + 1

    def _place(self, index: int) -> tuple[float, float, float]:
        p = self._states.pose[self._states.name.index(f"iris_{index}")].position
        return p.x, p.y, p.z

    def _errors(self) -> list[float]:
        """Return how far each follower is from its slot, m."""
        x, y, z = self._place(0)
        slots = [self._offsets[k :: COUNT - 1] for k in range(COUNT - 1)]
        return [
            math.dist(self._place(i), (x + slot[0], y + slot[1], z + slot[2])) for i, slot in enumerate(slots, start=1)
        ]

    def step(self) -> None:
        self._turn += 1
        if self._turn == 60:
            for i, publisher in enumerate(self._poses):
                pose = Pose()
                pose.position.x, pose.position.y, _ = self._place(i)
                pose.position.z = 3.0
                pose.orientation.w = 1.0
                publisher.publish(pose)
        elif self._turn in (75, 90):
            for publisher in self._commands:
                publisher.publish("OFFBOARD" if self._turn == 75 else "ARM")
        elif self._turn == 285:
            self._pattern.publish("cube")
        elif self._turn == 435:
            self._course.publish(Twist(linear=Vector3(0.5, 0.0, 0.0)))
        elif self._turn == 465:
            sums = {topic: total.hexdigest() for topic, total in self._sums.items()}
            told = {"sums": sums, "counts": self._counts, "errors": self._errors(), "time": rospy.get_time()}
            self._flight.publish(json.dumps(told))


def main() -> None:
    lockstep.init_node("pilot", rate=RATE)
    node = Pilot()
    lockstep.start()
    lockstep.spin(node.step)


if __name__ == "__main__":
    main()
