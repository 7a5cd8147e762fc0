"""ROS node for the global map of a vehicle, with the names of octomap_server.

For each vehicle ``T``, in addition to the sensor's topics of ``mapping.map_feed``:

==================================  ===============================  =================================================
topic or service                    type                             meaning
==================================  ===============================  =================================================
/T/octomap_binary, octomap_full     octomap_msgs/Octomap             out, while subscribed: free and occupied; log-odds
/T/octomap_point_cloud_centers      sensor_msgs/PointCloud2          out, while subscribed: occupied voxels
/T/projected_map                    nav_msgs/OccupancyGrid           out, while subscribed: seen from above
/T/octomap_binary, octomap_full     octomap_msgs/GetOctomap          service: the current map
/T/octomap_server/reset             std_srvs/Empty                   service: clear the map
/diagnostics                        diagnostic_msgs/DiagnosticArray  out: once a second, and on change
==================================  ===============================  =================================================
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rospy
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from octomap_msgs.msg import Octomap
from octomap_msgs.srv import GetOctomap, GetOctomapResponse
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Empty, EmptyResponse

import xtdrone_lockstep as lockstep
from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_control.vehicle_topics import VehicleReport
from xtdrone_planning.mapping.map_feed import MapFeed, SensorSettings
from xtdrone_planning.mapping.sensor_watch import SensorWatch
from xtdrone_planning.octree.octree_format import Octree, check_octree_file, encode, file_of
from xtdrone_planning.octree.octree_map import GlobalMap, OctreeSettings
from xtdrone_planning.octree.octree_messages import (
    MOST_CELLS,
    above_message,
    occupied_message,
    octomap_message,
    seen_from_above,
)

RATE = 20.0  # Hz

_WARNINGS = 60.0  # s between two equal ones


@dataclass(frozen=True)
class OctomapOptions(Settings):
    """Inputs and outputs of the node."""

    odometry: str = setting(
        "", text="odometry used to place the measurements: lidar_odometry, slam, ...; empty: the autopilot's estimate"
    )
    frame_id: str = setting("map", text="frame of the map and of these poses")
    interval: float = setting(
        0.0, low=0.0, high=60.0, unit="s", text="minimum time between two mapped measurements; others are skipped"
    )
    period: float = setting(2.0, low=0.05, high=60.0, unit="s", text="time between two publications")
    occupancy_min_z: float = setting(0.3, low=-1e4, high=1e4, unit="m", text="lowest voxel height in projected_map")
    occupancy_max_z: float = setting(1e4, low=-1e4, high=1e4, unit="m", text="highest voxel height in projected_map")
    file: str = setting("", text="file for the map at the end, .bt or .ot; several vehicles: .VEHICLE.bt; empty: none")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_octree_file(self.file)
        if self.occupancy_min_z > self.occupancy_max_z:
            raise SettingError(
                "occupancy_min_z", self.occupancy_min_z, f"at most occupancy_max_z {self.occupancy_max_z:g} m"
            )


class OctomapNodeSettings(NamedTuple):
    """All settings of the node."""

    options: OctomapOptions
    octree: OctreeSettings
    sensor: SensorSettings


def read_settings() -> OctomapNodeSettings:
    """Return the settings read from the private parameters.

    Raises:
        SettingError: a parameter is not allowed.
    """
    return OctomapNodeSettings(
        OctomapOptions.from_parameters(rospy.get_param),
        OctreeSettings.from_parameters(rospy.get_param),
        SensorSettings.read(),
    )


class VehicleOctomap:
    """ROS topics and services of one vehicle's map."""

    def __init__(self, name: str, settings: OctomapNodeSettings) -> None:
        """Declare the topics and services."""
        self._name, self._settings = name, settings
        self._map = GlobalMap(settings.octree, settings.options.interval)
        self._lock = threading.Lock()  # services run in their own threads
        self._watch = SensorWatch(settings.sensor.watch)
        MapFeed(name, self._map, self._watch, settings.sensor, odometry=settings.options.odometry)
        self._binary = lockstep.Publisher(f"/{name}/octomap_binary", Octomap, latch=True)
        self._full = lockstep.Publisher(f"/{name}/octomap_full", Octomap, latch=True)
        self._centres = lockstep.Publisher(f"/{name}/octomap_point_cloud_centers", PointCloud2, latch=True)
        self._above = lockstep.Publisher(f"/{name}/projected_map", OccupancyGrid, latch=True)
        self._diagnostics = VehicleReport(name, "octomap")
        rospy.Service(f"/{name}/octomap_binary", GetOctomap, lambda request: self._answer(binary=True))
        rospy.Service(f"/{name}/octomap_full", GetOctomap, lambda request: self._answer(binary=False))
        rospy.Service(f"/{name}/octomap_server/reset", Empty, self._on_reset)
        lockstep.add_reset_hook(self._restart)
        self._published = -math.inf

    def _restart(self) -> None:
        """Begin again, because simulated time was reset."""
        with self._lock:
            self._map.restart()
        self._watch.restart()
        self._published = -math.inf

    # services

    def _answer(self, binary: bool) -> GetOctomapResponse:
        return GetOctomapResponse(octomap_message(self.octree(binary), rospy.Time.now(), self._frame))

    def _on_reset(self, _: object) -> EmptyResponse:
        with self._lock:
            self._map.octree.clear()
        return EmptyResponse()

    @property
    def _frame(self) -> str:
        return self._settings.options.frame_id

    def octree(self, binary: bool) -> Octree:
        """Return the current map."""
        return encode(*self._blocks(), self._settings.octree.resolution, binary)

    def _blocks(self) -> tuple[NDArray[np.int64], NDArray[np.int16]]:
        """Return a copy of the map's blocks; see ``OctreeMap.blocks``."""
        with self._lock:  # a reset may come in between
            return self._map.octree.blocks()

    # turns

    def step(self) -> None:
        """Insert queued measurements; publish what is due. Call it at 20 Hz."""
        stamp = rospy.Time.now()
        with self._lock:
            self._map.update()
        if stamp.to_sec() - self._published >= self._settings.options.period:
            self._published = stamp.to_sec()
            self._publish(stamp)
        self._publish_report(stamp)

    def _publish(self, stamp: rospy.Time) -> None:
        topics = self._binary, self._full, self._centres, self._above
        if not any(topic.get_num_connections() for topic in topics):
            return
        options, resolution = self._settings.options, self._settings.octree.resolution
        blocks = self._blocks()
        for topic, binary in ((self._binary, True), (self._full, False)):
            if topic.get_num_connections():
                topic.publish(octomap_message(encode(*blocks, resolution, binary), stamp, self._frame))
        if self._centres.get_num_connections():
            self._centres.publish(occupied_message(*blocks, resolution, stamp, self._frame))
        if self._above.get_num_connections():
            heights = options.occupancy_min_z, options.occupancy_max_z
            cells, first = seen_from_above(*blocks, resolution, heights)
            if len(blocks[0]) and not cells.size:
                rospy.logwarn_throttle(
                    _WARNINGS, f"{self._name}: projected_map is empty: the map has more than {MOST_CELLS} cells"
                )
            self._above.publish(above_message(cells, first, resolution, stamp, self._frame))

    def _assess(self, now: float) -> tuple[int, str]:
        """Return level and text for the diagnostics."""
        octree = self._map.octree
        if octree.is_full:
            return DiagnosticStatus.ERROR, f"the map is full: {octree.memory:.0f} MB; new voxels are dropped"
        fault = self._watch.fault(now)
        if fault:
            return DiagnosticStatus.WARN, fault
        if not self._map.entered:
            return DiagnosticStatus.WARN, "no poses for the measurements so far"
        return DiagnosticStatus.OK, "mapping"

    def _publish_report(self, stamp: rospy.Time) -> None:
        (level, text), before = self._assess(stamp.to_sec()), self._diagnostics.level
        values = {
            "measurements": str(self._map.entered),
            "without poses": str(self._map.left_out),
            "memory, MB": f"{self._map.octree.memory:.1f}",
        }
        self._diagnostics.publish(stamp, level, text, values)
        if level > max(before, 0):
            rospy.logwarn(f"{self._name}: octomap: {text}")


class OctomapNode:
    """Maps of one or several vehicles in one process."""

    def __init__(self, names: Sequence[str]) -> None:
        """Declare the topics.

        Raises:
            SettingError: a parameter is not allowed.
        """
        settings = read_settings()
        self._file = settings.options.file
        self._maps = {name: VehicleOctomap(name, settings) for name in names}

    def step(self) -> None:
        """Run one cycle of every map."""
        for vehicle in self._maps.values():
            vehicle.step()

    def close(self) -> None:
        """Save the maps, if a file is set."""
        for name, vehicle in self._maps.items() if self._file else ():
            path = Path(self._file)
            if len(self._maps) > 1:
                path = path.with_suffix(f".{name}{path.suffix}")
            try:
                path.write_bytes(file_of(vehicle.octree(binary=path.suffix != ".ot")))
            except OSError as error:
                rospy.logwarn(f"{name}: octomap: the map was not saved: {error}")
