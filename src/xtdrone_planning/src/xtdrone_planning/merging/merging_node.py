"""ROS node that merges the maps of several vehicles into the frame of the first one.

For each vehicle ``T`` and every other ``S``:

===================================  ================================  ===============================================
topic                                type                              meaning
===================================  ================================  ===============================================
/T/octomap_point_cloud_centers       sensor_msgs/PointCloud2           in: T's map (``~cloud``)
/T/mavros/local_position/pose        geometry_msgs/PoseStamped         in: pose of T in its map
/T/ODOMETRY/odometry                 nav_msgs/Odometry                 in: instead, with ``~odometry``
/xtdrone/T/neighbours/S              nav_msgs/Odometry                 in: S relative to T, axes of T's map
/xtdrone/merged_map                  sensor_msgs/PointCloud2           out, latched
/tf                                  tf2_msgs/TFMessage                out: map to T/map of all merged vehicles
/diagnostics                         diagnostic_msgs/DiagnosticArray   out: a state for each vehicle, 1 Hz and on change
===================================  ================================  ===============================================

The result is published ``~latency`` of simulated time after its inputs, however long the registration takes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rospy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from tf2_msgs.msg import TFMessage

import xtdrone_lockstep as lockstep
from xtdrone_common.clouds import cloud_message, read_cloud
from xtdrone_common.pose_history import PoseHistory
from xtdrone_common.pose_messages import transform_message
from xtdrone_control.vehicle_topics import VehicleTopics
from xtdrone_lockstep.deferred_work import Deferred
from xtdrone_planning.merging.frame_links import Pairs
from xtdrone_planning.merging.map_chain import Merged, Placed, merge_maps, merge_points
from xtdrone_planning.merging.settings import FitSettings, LinkSettings, MergingOptions
from xtdrone_planning.octree.octree_format import encode, file_of
from xtdrone_planning.octree.octree_map import blocks_of

RATE = 10.0  # Hz
_REACH = 0.1  # s: maximum time between a pose and an estimate
_REPORT_PERIOD = 1.0  # s

Array = NDArray[np.float64]


class MergingSettings(NamedTuple):
    """All settings of the node."""

    options: MergingOptions
    link: LinkSettings
    fit: FitSettings


def read_settings() -> MergingSettings:
    """Return the settings read from the private parameters.

    Raises:
        SettingError: a parameter is not allowed.
    """
    return MergingSettings(
        MergingOptions.from_parameters(rospy.get_param),
        LinkSettings.from_parameters(rospy.get_param),
        FitSettings.from_parameters(rospy.get_param),
    )


class _Sample(NamedTuple):
    """An estimate with the poses at its time: time, s, positions, m, in the two maps, and deviation, m."""

    time: float
    seen: Array
    other: Array
    deviation: float


class VehicleMap:
    """Data that a vehicle publishes about itself.

    Attributes:
        points: (n, 3) m, its map.
        poses: x, y, z, m, and quaternion w, x, y, z, in its map.
        fault: problem with its map; empty: none.
    """

    def __init__(self, name: str, options: MergingOptions) -> None:
        """Subscribe to the topics of a vehicle."""
        self._name = name
        self.poses = PoseHistory(seconds=5.0, reach=_REACH)
        self.restart()
        lockstep.Subscriber(f"/{name}/{options.cloud}", PointCloud2, self._on_cloud, queue_size=1, buff_size=2**24)
        VehicleTopics(name, "pose", poses=self.poses, odometry=options.odometry)

    def restart(self) -> None:
        """Forget everything."""
        self.points: Array = np.empty((0, 3))
        self.fault = "no map has been received"

    def _on_cloud(self, message: PointCloud2) -> None:
        try:
            self.points, self.fault = read_cloud(message).points, ""
        except ValueError as error:
            self.fault = f"its map was rejected: {error}"
            rospy.logwarn_throttle(5.0, f"{self._name}: {self.fault}; the last valid one is kept")


class RelativeEstimates:
    """Latest estimates of one vehicle's position by another."""

    def __init__(self, observer: VehicleMap, other: VehicleMap, topic: str, settings: MergingSettings) -> None:
        """Subscribe to the estimates."""
        self._observer, self._other = observer, other
        self._interval = settings.options.interval
        self._samples: deque[_Sample] = deque(maxlen=settings.link.samples)
        self._waiting: Odometry | None = None
        lockstep.Subscriber(topic, Odometry, self._on_estimate, queue_size=1)

    def restart(self) -> None:
        """Forget everything."""
        self._samples.clear()
        self._waiting = None

    def _on_estimate(self, message: Odometry) -> None:
        since = message.header.stamp.to_sec() - self._samples[-1].time if self._samples else self._interval
        if self._waiting is None and since >= self._interval - 1e-6:
            self._waiting = message

    def step(self) -> None:
        """Store the latest estimate with the poses at its time."""
        message, self._waiting = self._waiting, None
        if message is None:
            return
        stamp = message.header.stamp
        own, other = self._observer.poses.at(stamp.to_nsec()), self._other.poses.at(stamp.to_nsec())
        p = message.pose.pose.position
        relative = np.array([p.x, p.y, p.z])
        variance = float(np.trace(np.reshape(message.pose.covariance, (6, 6))[:3, :3])) / 3.0
        if own is None or other is None or not np.isfinite([*relative, variance]).all() or variance < 0.0:
            return
        self._samples.append(_Sample(stamp.to_sec(), own[:3] + relative, other[:3], float(np.sqrt(variance))))

    def pairs(self) -> Pairs | None:
        """Return the estimates, or None if there are none."""
        if not self._samples:
            return None
        times, seen, other, deviations = zip(*self._samples, strict=True)
        return Pairs(np.array(times), np.array(seen), np.array(other), np.array(deviations))


class _Outcome(NamedTuple):
    """Merged maps and the merged map's points, (n, 3) m."""

    maps: Merged
    points: Array


class MapMergingNode:
    """ROS topics and state of the merged map."""

    def __init__(self, names: Sequence[str], settings: MergingSettings) -> None:
        """Declare the topics.

        Args:
            names: Names of the vehicles, at least two; the others are merged into the frame of the first.
            settings: Settings of the node.
        """
        self._names, self._settings = names, settings
        self._vehicles = [VehicleMap(name, settings.options) for name in names]
        self._estimates = {
            (i, j): RelativeEstimates(
                self._vehicles[i], self._vehicles[j], f"/xtdrone/{names[i]}/neighbours/{names[j]}", settings
            )
            for i in range(len(names))
            for j in range(len(names))
            if i != j
        }
        self._map = lockstep.Publisher("/xtdrone/merged_map", PointCloud2, latch=True)
        self._tf = lockstep.Publisher("/tf", TFMessage)
        self._diagnostics = lockstep.Publisher("/diagnostics", DiagnosticArray)
        self._deferred = Deferred(1, wait=lockstep.is_active())
        self._clear()
        lockstep.add_reset_hook(self._restart)

    def _clear(self) -> None:
        self._maps = Merged({}, {})
        self._points: Array = np.empty((0, 3))
        self._begun = self._reported = -np.inf

    def _restart(self) -> None:
        self._deferred.close()
        self._deferred = Deferred(1, wait=lockstep.is_active())
        for vehicle in self._vehicles:
            vehicle.restart()
        for estimates in self._estimates.values():
            estimates.restart()
        self._clear()

    def close(self) -> None:
        """End the worker, and save the merged map of all that has been received, if a file is set.

        The last published one is saved first, in case the process is killed before the merging is complete.
        """
        if not self._settings.options.file:
            self._deferred.close()
            return
        self._save()
        self._deferred.close()
        last = _outcome(*self._inputs(), self._settings)
        if set(last.maps.placed) >= set(self._maps.placed):
            self._points = last.points
            self._save()

    def _save(self) -> None:
        path, voxel = Path(self._settings.options.file), self._settings.options.voxel
        try:
            path.write_bytes(file_of(encode(*blocks_of(self._points, voxel), voxel, binary=path.suffix != ".ot")))
        except OSError as error:
            rospy.logwarn(f"the merged map was not saved: {error}")

    def step(self) -> None:
        """Start merging when it is due; publish finished results. Call it at 10 Hz."""
        stamp = rospy.Time.now()
        for estimates in self._estimates.values():
            estimates.step()
        for _, outcome in self._deferred.ready(stamp.to_nsec() // 1000):
            self._publish(outcome, stamp)
        if stamp.to_sec() - self._begun >= self._settings.options.period - 1e-6 and not len(self._deferred):
            self._begun = stamp.to_sec()
            due_us = stamp.to_nsec() // 1000 + round(self._settings.options.latency * 1e6)
            self._deferred.put(None, due_us, _outcome, *self._inputs(), self._settings)
        if stamp.to_sec() - self._reported >= _REPORT_PERIOD - 1e-6:
            self._report(stamp)

    def _inputs(self) -> tuple[list[Array], dict[tuple[int, int], Pairs]]:
        """Return the points of all maps, and the estimates by observer and other vehicle."""
        found = {ends: estimates.pairs() for ends, estimates in self._estimates.items()}
        pairs = {ends: found_pairs for ends, found_pairs in found.items() if found_pairs is not None}
        return [vehicle.points for vehicle in self._vehicles], pairs

    def _publish(self, outcome: _Outcome, stamp: rospy.Time) -> None:
        before, self._maps, self._points = set(self._maps.placed), outcome.maps, outcome.points
        frame = self._settings.options.frame_id
        self._map.publish(cloud_message(outcome.points, stamp, frame))
        for number, placed in sorted(self._maps.placed.items()):
            if number not in before and number:
                rospy.loginfo(f"{self._names[number]}: its map is {self._words(placed)}")
        for number in sorted(before - set(self._maps.placed)):
            rospy.logwarn(f"{self._names[number]}: its map is no longer merged: {self._reason(number)}")
        self._report(stamp)

    def _words(self, placed: Placed) -> str:
        through = f"merged through that of {self._names[placed.through]}"
        if placed.fit is None:
            return f"{through} by relative estimates alone"
        return f"{through}, residual {placed.fit.residual:.2f} m, overlap {100.0 * placed.fit.overlap:.0f} %"

    def _reason(self, number: int) -> str:
        if self._vehicles[number].fault:
            return self._vehicles[number].fault
        reasons = self._maps.reasons.get(number)
        if reasons is None:
            return "merging has not begun"
        told = [f"with {self._names[known]}: {text}" for known, text in reasons.items()]
        return "; ".join(told) or "no relative estimates with a merged vehicle"

    def _report(self, stamp: rospy.Time) -> None:
        """Publish the state of every vehicle, and tf of the merged ones."""
        self._reported = stamp.to_sec()
        message = DiagnosticArray(status=[self._status(number) for number in range(len(self._names))])
        message.header.stamp = stamp
        self._diagnostics.publish(message)
        for number, placed in sorted(self._maps.placed.items()):
            frames = self._settings.options.frame_id, f"{self._names[number]}/map"
            self._tf.publish(transform_message(placed.pose, stamp, *frames))

    def _status(self, number: int) -> DiagnosticStatus:
        name, placed = self._names[number], self._maps.placed.get(number)
        values = [KeyValue("points", str(len(self._vehicles[number].points)))]
        if placed is None or (self._vehicles[number].fault and not len(self._vehicles[number].points)):
            level, text = DiagnosticStatus.WARN, f"not merged: {self._reason(number)}"
        elif number == 0:
            level, text = DiagnosticStatus.OK, f"reference frame; {len(self._maps.placed)} maps are merged"
        else:
            level, text = DiagnosticStatus.OK, self._words(placed)
            values += _figures(placed)
        return DiagnosticStatus(level, f"{name}: map merging", text, name, values)


def _outcome(clouds: Sequence[Array], pairs: dict[tuple[int, int], Pairs], settings: MergingSettings) -> _Outcome:
    """Return the merged maps; called by the worker."""
    maps = merge_maps(clouds, pairs, settings.link, settings.fit)
    return _Outcome(maps, merge_points(clouds, maps.placed, settings.options.voxel))


def _figures(placed: Placed) -> list[KeyValue]:
    values = [KeyValue("deviation by relative estimates, m", f"{placed.deviation:.3f}")]
    if placed.fit is not None:
        values += [
            KeyValue("residual, m", f"{placed.fit.residual:.3f}"),
            KeyValue("overlap", f"{placed.fit.overlap:.3f}"),
            KeyValue("agreement", f"{placed.fit.agreement:.3f}"),
        ]
    return values
