"""Relative localisation node: estimates the positions of the other vehicles for each vehicle.

For each vehicle ``T`` that the node serves, and every other vehicle ``S`` of its type:

===========================================  ===========================  ============================================
topic                                        type                         meaning
===========================================  ===========================  ============================================
/T/uwb                                       xtdrone_msgs/RelativeRanges  in: ranges, and bearings, measured by T
/S/mavros/local_position/velocity_local      geometry_msgs/TwistStamped   in: broadcast odometry: velocity
/S/mavros/local_position/pose                geometry_msgs/PoseStamped    in: broadcast attitude and height; of T itself
                                                                          also where it believes to be
/xtdrone/T/swarm                             std_msgs/Float64MultiArray   out: N x 6 as /xtdrone/swarm: the own row as T
                                                                          reports it, the others estimated, or NaN
/xtdrone/T/neighbours/S                      nav_msgs/Odometry            out, while subscribed: position relative to
                                                                          T with covariance
===========================================  ===========================  ============================================

All axes are those of map. Followers use ``/xtdrone/T/swarm`` with ``~neighbours: estimated``. No position of a
neighbour in map is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rospy
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from std_msgs.msg import Float64MultiArray
from xtdrone_msgs.msg import RelativeRanges

import xtdrone_lockstep as lockstep
from xtdrone_common.cameras.camera_pose import rotation_matrix
from xtdrone_common.settings import Settings, setting
from xtdrone_control.vehicle_topics import VehicleTopics
from xtdrone_perception.localisation.relative_filter import FilterSettings, RelativeFilter

RATE = 30.0  # Hz, of followers
_STALE = 1.0  # s without odometry after which a neighbour is dropped
_FIELDS = 6  # of a vehicle in a swarm topic

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RelativeOptions(Settings):
    """Private parameters of the node, for all its vehicles."""

    sensor: str = setting("uwb", text="name of the range sensor's topic below the vehicle's namespace")
    antenna: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.08), low=-10.0, high=10.0, unit="m", text="position of every vehicle's antenna in base_link, FLU"
    )


class NeighbourEstimates:
    """One vehicle's filters and topics."""

    def __init__(
        self,
        index: int,
        names: Sequence[str],
        fleet: Sequence[VehicleTopics],
        options: RelativeOptions,
        how: FilterSettings,
    ) -> None:
        """Declare the topics.

        Args:
            index: Index of the vehicle.
            names: Names of all vehicles.
            fleet: broadcasts of all vehicles, shared.
            options: Options of the node.
            how: settings of the filters.
        """
        self._index, self._fleet = index, fleet
        self._options = options
        self._numbers = {name: i for i, name in enumerate(names) if i != index}
        self.filters = {i: RelativeFilter(how) for i in self._numbers.values()}
        name = names[index]
        self._swarm = lockstep.Publisher(f"/xtdrone/{name}/swarm", Float64MultiArray)
        self._details = {i: lockstep.Publisher(f"/xtdrone/{name}/neighbours/{other}", Odometry)
                         for other, i in self._numbers.items()}  # fmt: skip
        lockstep.Subscriber(f"/{name}/{options.sensor}", RelativeRanges, self._on_ranges)

    def restart(self) -> None:
        """Forget all neighbours."""
        for one in self.filters.values():
            one.restart()

    def _on_ranges(self, message: RelativeRanges) -> None:
        own = self._fleet[self._index]
        age = rospy.get_time() - message.header.stamp.to_sec()
        if own.pose is None or not 0.0 <= age < _STALE:
            return
        attitude = rotation_matrix(own.pose[3:].tolist())
        for entry in message.ranges:
            number = self._numbers.get(entry.vehicle)
            if number is None:
                continue
            other, one = self._fleet[number], self.filters[number]
            if other.pose is None:
                continue
            lever = (rotation_matrix(other.pose[3:].tolist()) - attitude) @ np.array(self._options.antenna)
            lever = lever - (other.velocity - own.velocity) * age  # its position at the time of measurement
            one.add_range(entry.range, entry.range_std, lever)
            if entry.has_bearing:
                one.add_bearing(entry.azimuth, entry.elevation, entry.bearing_std, attitude, lever, entry.range)

    def step(self, dt: float, now: float) -> None:
        """Predict the estimates ``dt`` s ahead and publish them."""
        own = self._fleet[self._index]
        for number, one in self.filters.items():
            other = self._fleet[number]
            if now - min(own.heard, other.heard) > _STALE:
                one.restart()
                continue
            one.predict(dt, other.velocity - own.velocity)
            if other.pose is not None and own.pose is not None:
                one.add_height(float(other.pose[2] - own.pose[2]))
        self._publish(own)

    def _publish(self, own: VehicleTopics) -> None:
        rows = np.full((len(self._fleet), _FIELDS), np.nan)
        if own.pose is not None:
            rows[self._index] = *own.pose[:3], *own.velocity
            for number, one in self.filters.items():
                if one.known:
                    rows[number] = *(own.pose[:3] + one.position), *self._fleet[number].velocity
        self._swarm.publish(Float64MultiArray(data=rows.ravel().tolist()))
        for number, publisher in self._details.items():
            if self.filters[number].known and publisher.get_num_connections():
                publisher.publish(self._odometry(number))

    def _odometry(self, number: int) -> Odometry:
        one, message = self.filters[number], Odometry()
        message.header.stamp, message.header.frame_id = rospy.Time.now(), "map"
        place, twist = message.pose.pose.position, message.twist.twist.linear
        place.x, place.y, place.z = one.position.tolist()
        message.pose.pose.orientation.w = 1.0
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = one.covariance
        message.pose.covariance = covariance.ravel().tolist()
        velocity = self._fleet[number].velocity - self._fleet[self._index].velocity
        twist.x, twist.y, twist.z = velocity.tolist()
        return message


class RelativeLocalisationNode:
    """NeighbourEstimates of one or several vehicles in one process."""

    def __init__(
        self, kind: str, ids: Sequence[int], count: int, options: RelativeOptions, how: FilterSettings
    ) -> None:
        """Declare the topics.

        Args:
            kind: vehicle type, as ``iris_uwb``.
            ids: vehicles whose estimates are computed here.
            count: number of vehicles.
            options: Options of the node.
            how: settings of the filters.
        """
        names = [f"{kind}_{i}" for i in range(count)]
        self._fleet = [VehicleTopics(name, "pose", "velocity") for name in names]
        self._estimates = [NeighbourEstimates(i, names, self._fleet, options, how) for i in ids]
        self._time: float | None = None
        lockstep.add_reset_hook(self._restart)

    def _restart(self) -> None:
        self._time = None
        for estimates in self._estimates:
            estimates.restart()

    def step(self) -> None:
        """Predict all estimates and publish them; call it at 30 Hz."""
        now = rospy.get_time()
        dt = 0.0 if self._time is None else max(now - self._time, 0.0)
        self._time = now
        for estimates in self._estimates:
            estimates.step(dt, now)
