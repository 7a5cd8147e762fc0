"""Topics on which MAVROS reports the state of a vehicle, as every node needs them: checked, and kept up to date.

=======================================  ==============================  =============================================
topic of vehicle ``T``                   type                            name
=======================================  ==============================  =============================================
/T/mavros/local_position/pose            geometry_msgs/PoseStamped       pose
/T/ODOMETRY/odometry                     nav_msgs/Odometry               pose, with an odometry in its place
/T/mavros/local_position/velocity_local  geometry_msgs/TwistStamped      velocity
/T/mavros/state                          mavros_msgs/State               state
/T/mavros/extended_state                 mavros_msgs/ExtendedState       extended_state
=======================================  ==============================  =============================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import rospy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Pose, PoseStamped, TwistStamped
from mavros_msgs.msg import ExtendedState, State
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from std_msgs.msg import Header

import xtdrone_lockstep as lockstep
from xtdrone_common.pose_history import PoseHistory
from xtdrone_common.pose_messages import pose_entry

Array = NDArray[np.float64]

_REPORT_PERIOD = 1.0  # s


class VehicleTopics:
    """The latest pose, velocity and state of a vehicle; poses and velocities that are invalid are ignored.

    A reset of simulated time forgets all of them.

    Attributes:
        name: Name of the vehicle.
        pose: Position x, y, z (m, map, ENU) and quaternion w, x, y, z from base_link (FLU), (7,); None: none yet.
        stamp: Time of the pose.
        velocity: (3,) m/s, map (ENU); 0: none yet.
        heard: Arrival of the last velocity, s of ROS time; minus infinity: none yet.
        armed, is_offboard: Arming state, and whether the vehicle is armed in OFFBOARD.
        is_in_air, is_on_ground: Whether a message has said so.
    """

    def __init__(
        self,
        name: str,
        *topics: str,
        poses: PoseHistory | None = None,
        odometry: str = "",
        on_pose: Callable[[rospy.Time, Array], None] | None = None,
    ) -> None:
        """Subscribe to topics, in their order.

        Args:
            name: Name of the vehicle.
            topics: Names of topics, see above.
            poses: History to which valid poses are added.
            odometry: Name of an odometry, e.g. ``slam``, whose poses are used; empty: the autopilot's estimate.
            on_pose: Called with time and entry of each valid pose.
        """
        self.name = name
        self._poses, self._on_entry = poses, on_pose
        self.restart()
        mavros = f"/{name}/mavros"
        for topic in topics:
            if topic == "pose" and odometry:
                lockstep.Subscriber(f"/{name}/{odometry}/odometry", Odometry, self._on_odometry)
            elif topic == "pose":
                lockstep.Subscriber(f"{mavros}/local_position/pose", PoseStamped, self._on_pose)
            elif topic == "velocity":
                lockstep.Subscriber(f"{mavros}/local_position/velocity_local", TwistStamped, self._on_velocity)
            elif topic == "state":
                lockstep.Subscriber(f"{mavros}/state", State, self._on_state)
            else:
                lockstep.Subscriber(f"{mavros}/extended_state", ExtendedState, self._on_extended_state)
        lockstep.add_reset_hook(self.restart)

    def restart(self) -> None:
        """Forget everything, because simulated time was reset."""
        self.pose: Array | None = None
        self.stamp = rospy.Time()
        self.velocity: Array = np.zeros(3)
        self.heard = -math.inf
        self.armed = self.is_offboard = self.is_in_air = self.is_on_ground = False
        if self._poses is not None:
            self._poses.clear()

    def recent_pose(self, now: float, longest: float) -> Array | None:
        """Return the pose, see above; None if it is older than ``longest`` s at ``now``, s of ROS time."""
        return None if self.pose is None or now - self.stamp.to_sec() > longest else self.pose

    def _on_pose(self, message: PoseStamped) -> None:
        self._enter(message.header, message.pose)

    def _on_odometry(self, message: Odometry) -> None:
        self._enter(message.header, message.pose.pose)

    def _enter(self, header: Header, pose: Pose) -> None:
        entry = pose_entry(pose.position, pose.orientation)
        if entry is None:
            return
        self.pose, self.stamp = entry, header.stamp
        if self._poses is not None:
            self._poses.add(header.stamp.to_nsec(), entry)
        if self._on_entry is not None:
            self._on_entry(header.stamp, entry)

    def _on_velocity(self, message: TwistStamped) -> None:
        v = message.twist.linear
        velocity = np.array([v.x, v.y, v.z])
        if np.isfinite(velocity).all():
            self.velocity, self.heard = velocity, rospy.get_time()

    def _on_state(self, message: State) -> None:
        self.armed, self.is_offboard = bool(message.armed), bool(message.armed) and message.mode == "OFFBOARD"

    def _on_extended_state(self, message: ExtendedState) -> None:
        self.is_on_ground = message.landed_state == ExtendedState.LANDED_STATE_ON_GROUND
        self.is_in_air = not self.is_on_ground


class VehicleReport:
    """State of a part of a vehicle on /diagnostics, on each change and once a second.

    Attributes:
        level: Last level of diagnostic_msgs/DiagnosticStatus; -1: none yet.
    """

    def __init__(self, vehicle: str, part: str) -> None:
        """Declare the topic."""
        self._vehicle, self._part = vehicle, part
        self._publisher = lockstep.Publisher("/diagnostics", DiagnosticArray)
        self.restart()
        lockstep.add_reset_hook(self.restart)

    def restart(self) -> None:
        """Forget what was reported, because simulated time was reset."""
        self.level, self._kind, self._time = -1, "", -math.inf

    def publish(self, stamp: rospy.Time, level: int, text: str, values: Mapping[str, str], kind: str = "") -> bool:
        """Publish the state if it is due; return whether it has changed.

        Args:
            stamp: Current time.
            level, text: Level and message of the status.
            values: Its values.
            kind: What else makes it another state besides the level.
        """
        has_changed = (level, kind) != (self.level, self._kind)
        if has_changed or stamp.to_sec() - self._time >= _REPORT_PERIOD:
            self.level, self._kind, self._time = level, kind, stamp.to_sec()
            pairs = [KeyValue(key, value) for key, value in values.items()]
            status = DiagnosticStatus(level, f"{self._vehicle}: {self._part}", text, self._vehicle, pairs)
            self._publisher.publish(DiagnosticArray(Header(stamp=stamp), [status]))
        return has_changed
