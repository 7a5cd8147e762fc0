"""``/xtdrone/vehicles``: the vehicles in the simulation, published whenever one joins or leaves.

/xtdrone/vehicles (std_msgs/String, latched): the text of ``/xtdrone/fleet``. Unlike a parameter, a topic reaches the
nodes of the lockstep in the same turn in each repetition of a flight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import rospy
from std_msgs.msg import String

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import Vehicle, fleet_text, parse_fleet

TOPIC = "/xtdrone/vehicles"

Fleet = tuple[Vehicle, ...]
Key = tuple[str, str]
"""Name and model of a vehicle: the same name with another model is another vehicle."""


class FleetTopic:
    """The simulator's side."""

    def __init__(self) -> None:
        """Advertise the topic; called after ``lockstep.host()``."""
        self._publisher = lockstep.Publisher(TOPIC, String, latch=True)

    def publish(self, fleet: Sequence[Vehicle]) -> None:
        """Publish the vehicles in the simulation."""
        self._publisher.publish(String(fleet_text(fleet)))


class FleetChanges:
    """The receiving side, for a node that serves the whole fleet: calls it for vehicles that join and leave."""

    def __init__(
        self, fleet: Sequence[Vehicle], joined: Callable[[Vehicle], None], left: Callable[[Vehicle], None]
    ) -> None:
        """Subscribe.

        Args:
            fleet: vehicles that the node serves.
            joined: called for a vehicle that has joined; raises ValueError if it cannot be served, which is logged.
            left: called for one that has left, before those that have joined.
        """
        self._there: dict[Key, Vehicle] = {_key(vehicle): vehicle for vehicle in fleet}
        self._refused: set[Key] = set()
        self._joined, self._left = joined, left
        lockstep.Subscriber(TOPIC, String, self._take)

    @property
    def fleet(self) -> Fleet:
        """The vehicles in the simulation."""
        return tuple(self._there.values())

    def _take(self, message: String) -> None:
        try:
            now = {_key(vehicle): vehicle for vehicle in parse_fleet(message.data)}
        except ValueError as error:
            rospy.logerr(f"{rospy.get_name()}: a message of {TOPIC} is ignored: {error}")
            return
        for key in [key for key in self._there if key not in now]:
            self._left(self._there.pop(key))
        self._refused &= now.keys()
        for key, vehicle in now.items():
            if key in self._there or key in self._refused:
                continue
            try:
                self._joined(vehicle)
                self._there[key] = vehicle
            except ValueError as error:
                self._refused.add(key)
                rospy.logerr(f"{vehicle.name} is not served by {rospy.get_name()}: {error}")


def _key(vehicle: Vehicle) -> Key:
    return vehicle.name, vehicle.model


def vehicles_may_join() -> bool:
    """Return whether the simulator keeps places for vehicles that join later."""
    return bool(rospy.get_param("/simulator/reserve", 0))
