"""A lockstep participant for tests: calls services in its own turn, and flies the same flight after every reset.

``/meddler/do`` (String, JSON: service, type) is answered on ``/meddler/done`` (String, JSON: the result, and the
simulated times before and after the call). With ``~fly`` it takes vehicle iris_0 off, from 3 s after each start, and
publishes on ``/meddler/flight`` (String, JSON) a checksum of the vehicle's true motion in the first 10 s.
"""

from __future__ import annotations

import hashlib
import io
import json
from typing import Any

import roslib.message
import rospy
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Pose
from std_msgs.msg import String

import xtdrone_lockstep as lockstep

RATE = 30.0


class Meddler:
    def __init__(self, fly: bool) -> None:
        self._fly = fly
        self._done = lockstep.Publisher("/meddler/done", String)
        self._flight = lockstep.Publisher("/meddler/flight", String, latch=True)
        self._command = lockstep.Publisher("/xtdrone/iris_0/cmd", String)
        self._pose = lockstep.Publisher("/xtdrone/iris_0/cmd_pose_enu", Pose)
        lockstep.Subscriber("/meddler/do", String, self._do)
        lockstep.Subscriber("/gazebo/model_states", ModelStates, self._see)
        lockstep.add_reset_hook(self._begin)
        self._begin()

    def _begin(self) -> None:
        self._turn = 0
        self._sum = hashlib.sha256()
        self._height = 0.0

    def _see(self, states: Any) -> None:
        self._height = states.pose[1].position.z
        content = io.BytesIO()
        states.serialize(content)
        self._sum.update(content.getvalue())

    def _do(self, message: String) -> None:
        wanted = json.loads(message.data)
        kind = roslib.message.get_service_class(wanted["type"])
        before = rospy.get_time()
        try:
            answer = rospy.ServiceProxy(wanted["service"], kind)(**wanted.get("fields", {}))
            said = {name: str(getattr(answer, name)) for name in answer.__slots__}
        except rospy.ServiceException as error:
            said = {"error": str(error)}
        self._done.publish(json.dumps({"said": said, "before": before, "after": rospy.get_time()}))

    def step(self) -> None:
        self._turn += 1
        if not self._fly:
            return
        if self._turn == 90:
            pose = Pose()
            pose.position.z = 3.0
            pose.orientation.w = 1.0
            self._pose.publish(pose)
        elif self._turn == 105:
            self._command.publish("OFFBOARD")
        elif self._turn == 120:
            self._command.publish("ARM")
        elif self._turn == 300:
            told = {"sum": self._sum.hexdigest(), "time": rospy.get_time(), "height": self._height}
            self._flight.publish(json.dumps(told))


def main() -> None:
    lockstep.init_node("meddler", rate=RATE)
    node = Meddler(bool(rospy.get_param("~fly", False)))
    lockstep.start()
    lockstep.spin(node.step)


if __name__ == "__main__":
    main()
