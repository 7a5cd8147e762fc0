"""The explorer of a vehicle as a ROS node.

For each vehicle ``T``; the topics of others come by ``radio.py``:

==================================  ===============================  =================================================
topic                               type                             meaning
==================================  ===============================  =================================================
/T/exploration/start                geometry_msgs/PoseStamped        in: explore, then fly to this position
/T/map/slice, /T/map/occupied       OccupancyGrid, PointCloud2       in: the planner's local map
/T/planner/state                    std_msgs/String                  in
/T/mavros/local_position/pose       geometry_msgs/PoseStamped        in
/T/radio/exploration/floor          xtdrone_msgs/SharedFloor         in: the others' maps; the pose of the map's origin
                                                                     is in this vehicle's map frame
/T/radio/exploration/share          xtdrone_msgs/RegionShare         in: the others' regions and proposals
/T/planner/goal                     geometry_msgs/PoseStamped        out
/T/exploration/floor, share         SharedFloor, RegionShare         out: for the others
/T/exploration/map                  nav_msgs/OccupancyGrid           out, while subscribed: the merged map
/T/exploration/state                std_msgs/String                  out, latched, on change: see ``explorer``
/diagnostics                        diagnostic_msgs/DiagnosticArray  out: once a second
==================================  ===============================  =================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import rospy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from xtdrone_msgs.msg import RegionShare, SharedFloor

import xtdrone_lockstep as lockstep
from xtdrone_common.clouds import ScanError
from xtdrone_control.vehicle_topics import VehicleTopics
from xtdrone_planning.exploration.choice_of_frontier import HOME, STRANDED, Decision, Explorer
from xtdrone_planning.exploration.exploration_messages import (
    FloorError,
    cells_of,
    floor_message,
    share_message,
    share_of,
    slice_of,
)
from xtdrone_planning.exploration.settings import ExplorationSettings
from xtdrone_planning.mapping.map_messages import FRAME

RATE = 2.0  # Hz

_LEVEL = 0.4  # m by which a slice may differ from the flight height
_SLAB = 0.4  # m above and below the layer at flight height within which obstacles count
_STALE = 2.0  # s without a slice, or a pose
_FLOOR_PERIOD = 1.0  # s
_WARNINGS = 5.0  # s between two identical warnings


class VehicleExplorer:
    """ROS topics of one vehicle's explorer."""

    def __init__(self, name: str, fleet: Sequence[str], settings: ExplorationSettings) -> None:
        """Declare the topics.

        Args:
            name: Name of the vehicle.
            fleet: names of all exploring vehicles.
            settings: Settings of the exploration.
        """
        self._name, self._fleet, self._settings = name, tuple(fleet), settings
        self._goal = lockstep.Publisher(f"/{name}/planner/goal", PoseStamped)
        self._floor = lockstep.Publisher(f"/{name}/exploration/floor", SharedFloor)
        self._share = lockstep.Publisher(f"/{name}/exploration/share", RegionShare)
        self._map = lockstep.Publisher(f"/{name}/exploration/map", OccupancyGrid)
        self._state = lockstep.Publisher(f"/{name}/exploration/state", String, latch=True)
        self._diagnostics = lockstep.Publisher("/diagnostics", DiagnosticArray)
        lockstep.Subscriber(f"/{name}/exploration/start", PoseStamped, self._on_start)
        lockstep.Subscriber(f"/{name}/map/occupied", PointCloud2, self._on_occupied)
        lockstep.Subscriber(f"/{name}/map/slice", OccupancyGrid, self._on_slice)
        lockstep.Subscriber(f"/{name}/planner/state", String, self._on_planner)
        self._vehicle = VehicleTopics(name, "pose")
        lockstep.Subscriber(f"/{name}/radio/exploration/floor", SharedFloor, self._on_floor)
        lockstep.Subscriber(f"/{name}/radio/exploration/share", RegionShare, self._on_share)
        lockstep.add_reset_hook(self._restart)
        self._restart()

    def _restart(self) -> None:
        """Begin again, because simulated time was reset."""
        self._explorer = Explorer(self._settings, self._name, self._fleet)
        self._count = self._explorer.region_count
        self._sliced = self._told = -math.inf
        self._occupied: PointCloud2 | None = None
        self._planner = self._published = ""

    # messages

    def _on_start(self, message: PoseStamped) -> None:
        place = message.pose.position
        if not all(map(math.isfinite, (place.x, place.y))) or message.header.frame_id.lstrip("/") not in ("", FRAME):
            rospy.logwarn(f"{self._name}: start: ignored: the position must be finite and in frame {FRAME!r}")
            return
        self._explorer.start(np.array([place.x, place.y]))

    def _on_planner(self, message: String) -> None:
        self._planner = message.data

    def _on_occupied(self, message: PointCloud2) -> None:
        self._occupied = message

    def _on_slice(self, message: OccupancyGrid) -> None:
        level = abs(message.info.origin.position.z - self._settings.flight_height) <= _LEVEL
        occupied = self._occupied
        if not level or occupied is None or occupied.header.stamp != message.header.stamp:
            return
        cell, enter = self._settings.cell, self._explorer.floor.enter
        self._try("map/slice", lambda: enter(*slice_of(message, occupied, cell, _SLAB)))
        self._sliced = message.header.stamp.to_sec()

    def _on_floor(self, message: SharedFloor) -> None:
        if message.vehicle in self._fleet and message.vehicle != self._name:
            hear = self._explorer.floor.hear
            self._try("floor", lambda: hear(message.vehicle, *cells_of(message.map, self._settings.cell)))

    def _on_share(self, message: RegionShare) -> None:
        hear, now = self._explorer.sharing.hear, rospy.get_time()
        self._try("share", lambda: hear(share_of(message, self._count), now))

    def _try(self, what: str, action: Callable[[], None]) -> None:
        """Process a message, or warn that it is invalid."""
        try:
            action()
        except (FloorError, ScanError) as error:
            rospy.logwarn_throttle_identical(_WARNINGS, f"{self._name}: {what}: {error}; ignored")

    # turns

    def step(self) -> None:
        """Run one update; call it at 2 Hz."""
        stamp = rospy.Time.now()
        now = stamp.to_sec()
        pose = self._vehicle.recent_pose(now, _STALE)
        if pose is None:
            self._report(stamp, 2, "no position from the autopilot")
            return
        if now - self._sliced > _STALE and self._explorer.state != HOME:
            self._report(stamp, 1, "no local map at flight height from the planner")
            return
        decision = self._explorer.step(now, pose[:2], self._planner)
        height = self._settings.flight_height
        if decision.goal is not None:
            self._send_goal(decision, stamp)
        for share in decision.messages:
            self._share.publish(share_message(share, height, stamp, FRAME))
        if now - self._told >= _FLOOR_PERIOD:
            self._told = now
            floor = self._explorer.floor
            self._floor.publish(SharedFloor(self._name, floor_message(floor, floor.own, height, stamp, FRAME)))
            if self._map.get_num_connections():
                self._map.publish(floor_message(floor, floor.values, height, stamp, FRAME))
        self._report(stamp, *self._assess(decision))

    def _send_goal(self, decision: Decision, stamp: rospy.Time) -> None:
        assert decision.goal is not None
        message = PoseStamped()
        message.header.stamp, message.header.frame_id = stamp, FRAME
        place = message.pose.position
        place.x, place.y = decision.goal.tolist()
        place.z, message.pose.orientation.w = self._settings.flight_height, 1.0
        self._goal.publish(message)

    def _assess(self, decision: Decision) -> tuple[int, str]:
        """Return level and text for the diagnostics."""
        if decision.state == STRANDED:
            return 2, decision.state
        lost = self._explorer.sharing.lost()
        notes = [f"{', '.join(lost)} lost: others take over"] if lost else []
        if self._explorer.unreachable:
            notes.append(f"{self._explorer.unreachable} frontiers unreachable")
        return (1 if lost else 0), "; ".join([decision.state, *notes])

    def _report(self, stamp: rospy.Time, level: int, text: str) -> None:
        explorer = self._explorer
        if explorer.state != self._published:
            self._published = explorer.state
            self._state.publish(String(explorer.state))
        status = DiagnosticStatus(level=level, name=f"{self._name}: exploration", message=text, hardware_id=self._name)
        status.values = [
            KeyValue("known", f"{explorer.floor.share_known():.3f}"),
            KeyValue("frontiers", str(len(explorer.frontiers))),
            KeyValue("regions", ",".join(map(str, sorted(explorer.sharing.own)))),
        ]
        message = DiagnosticArray(status=[status])
        message.header.stamp = stamp
        self._diagnostics.publish(message)


class ExplorerNode:
    """Explorers of one or several vehicles in one process."""

    def __init__(self, names: Sequence[str], fleet: Sequence[str]) -> None:
        """Declare the topics.

        Raises:
            SettingError: a parameter is not allowed.
        """
        settings = ExplorationSettings.from_parameters(rospy.get_param)
        self._explorers = [VehicleExplorer(name, fleet or names, settings) for name in names]

    def step(self) -> None:
        """Run one update of every explorer."""
        for explorer in self._explorers:
            explorer.step()
