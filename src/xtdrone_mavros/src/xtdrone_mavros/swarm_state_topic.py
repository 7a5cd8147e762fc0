"""Positions and velocities of all vehicles in one message: N messages instead of N^2 for a swarm of many nodes.

Real MAVROS has no equivalent: a node that flies with it subscribes to every ``local_position/pose`` instead.
"""

from __future__ import annotations

import math
from typing import Any

from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed, Ros, Topic
from xtdrone_mavros.uas import Plugin, Uas

TOPIC = "/xtdrone/swarm"
FIELDS = 6  # x, y, z in m, vx, vy, vz in m/s, ENU


class Swarm:
    """Topic with an array of shape (vehicles, FIELDS), NaN for vehicles without a position so far.

    Attributes:
        topic: refreshed by the vehicles' hubs.
    """

    def __init__(self, ros: Ros, count: int) -> None:
        """Advertise the topic for ``count`` vehicles."""
        message = Float64MultiArray()
        message.layout.dim = [
            MultiArrayDimension("vehicle", count, count * FIELDS),
            MultiArrayDimension("x y z vx vy vz, ENU", FIELDS, FIELDS),
        ]
        self.topic = Topic(ros.publisher(TOPIC, Float64MultiArray, False), message, False)
        self._values = [math.nan] * (count * FIELDS)
        self._changed = False

    def set(self, index: int, position: frames.Vector, velocity: frames.Vector) -> None:
        """Set a vehicle's position (m) and velocity (m/s), ENU."""
        start = index * FIELDS
        self._values[start : start + FIELDS] = (*position, *velocity)
        self._changed = True

    def forget(self, index: int) -> None:
        """Set a vehicle's values to NaN."""
        start = index * FIELDS
        self._values[start : start + FIELDS] = [math.nan] * FIELDS

    def publish(self) -> None:
        """Publish if a value has changed since the last call."""
        if self._changed and self.topic.needed:
            self.topic.message.data = self._values
            self.topic.publish(self.topic.message)
        self._changed = False

    def member(self, index: int) -> _Member:
        """Return a plugin factory for vehicle ``index``, for ``Uas``."""
        return _Member(self, index)


class SwarmPlugin(Plugin):
    """One vehicle's contribution to the swarm topic."""

    name = "swarm"
    listed = False

    def __init__(self, uas: Uas, swarm: Swarm, index: int) -> None:
        """Update row ``index`` of ``swarm``."""
        super().__init__(uas)
        self._swarm = swarm
        self._index = index
        uas.share(swarm.topic)
        self.messages = {"LOCAL_POSITION_NED": Feed(self._on_position, swarm.topic)}

    def connected(self, connected: bool) -> None:
        """Clear the position when an autopilot connects or reboots."""
        if connected:
            self._swarm.forget(self._index)

    def _on_position(self, ned: Any) -> None:
        self._swarm.set(self._index, frames.ned_to_enu(ned.x, ned.y, ned.z), frames.ned_to_enu(ned.vx, ned.vy, ned.vz))


class _Member:
    """Factory of one vehicle's plugin."""

    name = SwarmPlugin.name
    listed = SwarmPlugin.listed

    def __init__(self, swarm: Swarm, index: int) -> None:
        self._swarm = swarm
        self._index = index

    def __call__(self, uas: Uas) -> SwarmPlugin:
        return SwarmPlugin(uas, self._swarm, self._index)
