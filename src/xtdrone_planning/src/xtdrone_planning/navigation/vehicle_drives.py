"""Drives of the navigation: a ground robot, or a UAV at a fixed height through MAVROS's or XTDrone's velocity
setpoints."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import rospy
from geometry_msgs.msg import Twist, Vector3
from mavros_msgs.msg import PositionTarget
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from tf2_msgs.msg import TFMessage

import xtdrone_lockstep as lockstep
from xtdrone_common.pose_messages import pose_entry
from xtdrone_common.rotation import constrain, multiply, rotate, yaw_of
from xtdrone_common.settings import Settings, setting
from xtdrone_control.communication.commands import CommandRequest
from xtdrone_control.communication.multirotor import MavrosServices
from xtdrone_control.communication.setpoint import IGNORE_ACCELERATION, IGNORE_POSITION, IGNORE_YAW
from xtdrone_control.vehicle_topics import VehicleTopics
from xtdrone_planning.navigation.dynamic_window import AT_REST, Motion

Array = NDArray[np.float64]

_CLIMB_GAIN, _MOST_CLIMB = 1.0, 0.5  # 1/s, m/s, towards the flight height
_HOLD_GAIN, _MOST_HOLD = 0.8, 0.5  # 1/s, m/s, towards the position where the vehicle came to rest
_STREAM_LEAD = 0.5  # s of setpoints before OFFBOARD is requested; PX4 rejects it without a stream
_REQUEST_SPACING = 2.0  # s between requests


@dataclass(frozen=True)
class DriveSettings(Settings):
    """Type of drive, and its settings."""

    drive: str = setting(
        "auto", choices=("auto", "mavros", "xtdrone", "ground"),
        text="mavros: setpoint_raw/local; xtdrone: cmd_vel_flu of a communication node; ground: cmd_vel of a robot; "
        "auto: mavros for the fleet's vehicles, ground for others",
    )  # fmt: skip
    height: float = setting(
        0.0, low=0.0, high=1000.0, unit="m", text="flight height; 0: the height when a goal is received"
    )
    offboard: bool = setting(True, text="request OFFBOARD for a goal (of drive mavros); false: wait for the pilot")


class Drive:
    """A vehicle; the methods here are those of one that always obeys."""

    def restart(self) -> None:
        """Forget everything, because simulated time was reset."""

    def obstacle_to_goals(self) -> str:
        """Return why goals cannot be accepted; empty if they can."""
        raise NotImplementedError

    def begin(self) -> None:
        """Begin with a goal."""

    def obeys(self) -> bool:
        """Return whether the vehicle moves as commanded."""
        return True

    def is_lost(self) -> bool:
        """Return whether a pilot or another program has taken the vehicle over since ``begin``."""
        return False

    def command(self, motion: Motion, stamp: rospy.Time, *, active: bool) -> None:
        """Command a motion; ``active``: there is a goal, or the vehicle is still moving."""
        raise NotImplementedError

    def halt(self) -> None:
        """Stop because the vehicle's pose is unknown; call it in every turn until the pose is known again."""

    def close(self) -> None:
        """Cancel pending requests."""


class PoseFeed(Protocol):
    """Receives the poses of a vehicle."""

    def __call__(self, stamp: rospy.Time, entry: Array) -> None:
        """Receive a pose: x, y, z, m in map, and quaternion w, x, y, z."""


class GroundDrive(Drive):
    """A ground robot: odometry relative to its start pose on /tf_static, and ``cmd_vel``."""

    def __init__(self, name: str, feed: PoseFeed) -> None:
        """Declare the topics."""
        self._odom, self._feed = f"{name}/odom", feed
        self._publisher = lockstep.Publisher(f"/{name}/cmd_vel", Twist)
        lockstep.Subscriber("/tf_static", TFMessage, self._on_frames)
        lockstep.Subscriber(f"/{name}/odom", Odometry, self._on_odometry)
        self._start: Array | None = None
        self.restart()

    def restart(self) -> None:
        """Forget the last command; the start pose stays."""
        self._was_active = False

    def _on_frames(self, message: TFMessage) -> None:
        for frame in message.transforms:
            if frame.child_frame_id == self._odom and frame.header.frame_id == "map":
                start = pose_entry(frame.transform.translation, frame.transform.rotation)
                self._start = self._start if start is None else start

    def _on_odometry(self, message: Odometry) -> None:
        found = pose_entry(message.pose.pose.position, message.pose.pose.orientation)
        if found is None or self._start is None:
            return
        turn = tuple(self._start[3:].tolist())
        place = self._start[:3] + np.array(rotate(turn, *found[:3].tolist()))
        self._feed(message.header.stamp, np.array([*place, *multiply(turn, tuple(found[3:].tolist()))]))

    def obstacle_to_goals(self) -> str:
        """Return why goals cannot be accepted."""
        return "" if self._start is not None else f"no transform from map to {self._odom} on /tf_static"

    def command(self, motion: Motion, stamp: rospy.Time, *, active: bool) -> None:
        """Publish the command; at the end a single stop command, then nothing."""
        if active or self._was_active:
            self._publisher.publish(Twist(linear=Vector3(x=motion.speed), angular=Vector3(z=motion.rate)))
        self._was_active = active

    def halt(self) -> None:
        """Command a stop: the robot would continue with the last command."""
        if self._was_active:
            self._publisher.publish(Twist())


class UavDrive(Drive):
    """A UAV at a fixed height: subscribes to MAVROS's estimate and publishes velocity setpoints.

    While its position is unknown it publishes none: the autopilot's failsafe acts.
    """

    def __init__(self, name: str, settings: DriveSettings, feed: PoseFeed) -> None:
        """Declare the topics."""
        self._settings = settings
        self._by_mavros = settings.drive != "xtdrone"
        if self._by_mavros:
            self._publisher = lockstep.Publisher(f"/{name}/mavros/setpoint_raw/local", PositionTarget)
        else:
            self._publisher = lockstep.Publisher(f"/xtdrone/{name}/cmd_vel_flu", Twist)
        self._services = MavrosServices(name, in_lockstep=lockstep.is_active())
        self._vehicle = VehicleTopics(name, "pose", "state", "extended_state", on_pose=feed)
        self.restart()

    def restart(self) -> None:
        """Forget the last commands."""
        self._streams = self._was_offboard = False
        self._streaming_since = self._requested = -math.inf
        self._height = self._settings.height
        self._hold: Array | None = None

    def obstacle_to_goals(self) -> str:
        """Return why goals cannot be accepted."""
        if self._vehicle.pose is None:
            return "no position from the autopilot"
        return "" if self._vehicle.armed and self._vehicle.is_in_air else "the vehicle is not flying"

    def begin(self) -> None:
        """Start flying to a goal, at the current height if none is set."""
        assert self._vehicle.pose is not None
        self._height = self._settings.height or float(self._vehicle.pose[2])
        if not self._streams:
            self._streaming_since, self._was_offboard = rospy.get_time(), self._vehicle.is_offboard
            self._hold = None  # the vehicle may have been moved since
        self._streams = True

    def obeys(self) -> bool:
        """Return whether the vehicle is in OFFBOARD."""
        return self._vehicle.is_offboard

    def is_lost(self) -> bool:
        """Return whether OFFBOARD has ended since it began, or the vehicle is on the ground."""
        vehicle = self._vehicle
        self._was_offboard = self._was_offboard or vehicle.is_offboard
        obeys = vehicle.is_offboard or not self._was_offboard
        return self._streams and not (vehicle.armed and vehicle.is_in_air and obeys)

    def command(self, motion: Motion, stamp: rospy.Time, *, active: bool) -> None:
        """Publish velocity and yaw rate; once at rest, the vehicle holds its position until it is taken over."""
        if self.is_lost() and not active:
            self._streams = False
        pose = self._vehicle.pose
        if not self._streams or pose is None:
            return
        climb = constrain(_CLIMB_GAIN * (self._height - float(pose[2])), -_MOST_CLIMB, _MOST_CLIMB)
        if self._by_mavros:
            east, north = self._level_velocity(motion, pose)
            self._publish_target((east, north, climb), motion.rate, stamp)
            self._request_offboard(stamp.to_sec())
        else:
            self._publisher.publish(
                Twist(linear=Vector3(motion.speed, 0.0, climb), angular=Vector3(0.0, 0.0, motion.rate))
            )

    def _level_velocity(self, motion: Motion, pose: Array) -> tuple[float, float]:
        """Return the velocity, m/s east and north, of a motion; at rest, the velocity back to where the vehicle
        stopped."""
        yaw = yaw_of(pose[3:].tolist())
        if motion.speed != AT_REST.speed:
            self._hold = None
            return motion.speed * math.cos(yaw), motion.speed * math.sin(yaw)
        if self._hold is None or not self._vehicle.is_offboard:  # until OFFBOARD begins, the pilot may move the vehicle
            self._hold = pose[:2].copy()
        east, north = (_HOLD_GAIN * (self._hold - pose[:2])).tolist()
        return constrain(east, -_MOST_HOLD, _MOST_HOLD), constrain(north, -_MOST_HOLD, _MOST_HOLD)

    def _publish_target(self, velocity: tuple[float, float, float], rate: float, stamp: rospy.Time) -> None:
        message = PositionTarget(coordinate_frame=PositionTarget.FRAME_LOCAL_NED)
        message.header.stamp, message.header.frame_id = stamp, "map"
        message.type_mask = IGNORE_POSITION | IGNORE_ACCELERATION | IGNORE_YAW
        message.velocity, message.yaw_rate = Vector3(*velocity), rate
        self._publisher.publish(message)

    def _request_offboard(self, now: float) -> None:
        for request, accepted, reason in self._services.finished():
            if not accepted:
                rospy.logwarn(f"{self._vehicle.name}: {request.command} was rejected ({reason or 'no reason given'})")
        if self._vehicle.is_offboard or self._was_offboard or not self._settings.offboard:
            return
        if now - self._streaming_since >= _STREAM_LEAD and now - self._requested >= _REQUEST_SPACING:
            self._requested = now
            self._services.submit(CommandRequest("OFFBOARD", None))

    def close(self) -> None:
        """Cancel pending service calls."""
        self._services.close()


def drive_of(name: str, settings: DriveSettings, feed: PoseFeed, *, is_robot: bool) -> Drive:
    """Return the drive of a vehicle, or of a ground robot."""
    is_ground = settings.drive == "ground" or (settings.drive == "auto" and is_robot)
    return GroundDrive(name, feed) if is_ground else UavDrive(name, settings, feed)
