"""The command topics of a vehicle or the leader, as XTDrone's keyboard publishes them."""

from __future__ import annotations

import threading

import rospy
from geometry_msgs.msg import Twist
from std_msgs.msg import String

import xtdrone_lockstep as lockstep

from .key_bindings import Setpoint

PERIOD = 0.1  # s of wall time between two setpoints: XTDrone's 10 Hz
_KEPT = 10  # queue of a topic


class CommandTopics:
    """Command topics of a vehicle or the leader; publishing never blocks."""

    def __init__(self, name: str, mode: str) -> None:
        """Advertise the topics.

        Args:
            name: of the vehicle, or ``leader``.
            mode: ``vel`` or ``accel``.
        """
        self._command = lockstep.UncountedPublisher(f"/xtdrone/{name}/cmd", String, queue_size=_KEPT)
        self._connected = threading.Event()
        listener = rospy.SubscribeListener()
        listener.peer_subscribe = lambda *_: self._connected.set()
        self._command.impl.add_subscriber_listener(listener)
        self._steering = lockstep.UncountedPublisher(f"/xtdrone/{name}/cmd_{mode}_flu", Twist, queue_size=_KEPT)

    @property
    def has_subscriber(self) -> bool:
        """Whether a node receives commands."""
        return bool(self._command.get_num_connections())

    def wait_for_subscriber(self, limit: float) -> bool:
        """Wait until a node receives commands, at most ``limit`` s of wall time; return whether one does."""
        return self.has_subscriber or self._connected.wait(max(limit, 0.0))

    def send_command(self, text: str) -> None:
        """Publish a command."""
        self._command.publish(String(data=text))

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """Publish a velocity or acceleration."""
        twist = Twist()
        twist.linear.x, twist.linear.y, twist.linear.z = setpoint.forward, setpoint.left, setpoint.up
        twist.angular.z = setpoint.turn
        self._steering.publish(twist)
