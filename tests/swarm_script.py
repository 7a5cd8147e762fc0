"""A lockstep participant for tests: commands the leader by a script, and records /xtdrone/swarm in each turn.

``swarm_script.py FILE``: at the end of the script the positions, shape (turns, N, 3), go to FILE (.npy), and
``/script/done`` (String, latched) reports it.
"""

from __future__ import annotations

import sys

import numpy as np
import rospy
from geometry_msgs.msg import Twist
from std_msgs.msg import Float64MultiArray, String

import xtdrone_lockstep as lockstep

RATE = 30.0
TURNS = 420
PATTERNS = {10: "cube", 330: "origin"}
"""Turn to the pattern that is asked for in it."""
COURSE = ((0.8, -0.3, 0.2), 0.25)
"""m/s FLU, rad/s; of every turn from 200 to 280, with a stop in the next."""
STEERED = range(200, 281)


class Script:
    def __init__(self, file: str) -> None:
        self._file = file
        self._turn = 0
        self._rows: list[np.ndarray] = []
        self._command = lockstep.Publisher("/xtdrone/leader/cmd", String)
        self._course = lockstep.Publisher("/xtdrone/leader/cmd_vel_flu", Twist)
        self._done = lockstep.Publisher("/script/done", String, latch=True)
        lockstep.Subscriber("/xtdrone/swarm", Float64MultiArray, self._take)

    def _take(self, message: Float64MultiArray) -> None:
        self._rows.append(np.array(message.data).reshape(-1, 6)[:, :3])

    def step(self) -> None:
        self._turn += 1
        if self._turn in PATTERNS:
            self._command.publish(PATTERNS[self._turn])
        if self._turn in STEERED:
            (x, y, z), yaw_rate = COURSE
            twist = Twist()
            twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z = x, y, z, yaw_rate
            self._course.publish(twist)
        elif self._turn == STEERED.stop:
            self._course.publish(Twist())
        if self._turn == TURNS:
            np.save(self._file, np.array(self._rows))
            self._done.publish("done")


def main() -> None:
    file = rospy.myargv(sys.argv)[1]
    lockstep.init_node("script", rate=RATE)
    node = Script(file)
    lockstep.start()
    lockstep.spin(node.step)


if __name__ == "__main__":
    main()
