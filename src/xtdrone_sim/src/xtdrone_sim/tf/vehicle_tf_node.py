"""The node that publishes TF of all vehicles; see ``nodes/robot_tf.py``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import rospy
from geometry_msgs.msg import PoseStamped, Quaternion, Transform, TransformStamped, Vector3
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import Vehicle
from xtdrone_common.frames import to_xyzw
from xtdrone_common.programs.node_command_line import ArgumentError, check_no_arguments, needed_fleet
from xtdrone_common.settings import Settings, setting
from xtdrone_sim.tf.vehicle_frames import Frame, RobotFrames
from xtdrone_sim.topics.fleet_changes import FleetChanges
from xtdrone_sim.vehicles.vehicle_model import VehicleModel, load_vehicle
from xtdrone_worlds.descriptions import ModelError


@dataclass(frozen=True)
class TfSettings(Settings):
    """Private parameters of the node."""

    rate: float = setting(30.0, low=1.0, high=50.0, unit="Hz", text="publishing rate in simulated time")
    frame_id: str = setting("map", text="frame of the vehicles' positions")
    body: bool = setting(True, text="publish the vehicles' positions; false: odometry publishes VEHICLE/base_link")


def transform(frame: Frame, stamp: rospy.Time) -> TransformStamped:
    """Return the TF message of a frame."""
    header = Header(stamp=stamp, frame_id=frame.parent)
    turn = Quaternion(*to_xyzw(frame.pose.orientation))
    return TransformStamped(header, frame.child, Transform(Vector3(*frame.pose.position), turn))


class _Robot(NamedTuple):
    """Frames and topics of a vehicle."""

    frames: RobotFrames
    subscribers: list[lockstep.Subscriber]


class RobotTf:
    """Collects the messages received in a turn and publishes them as one TF message."""

    def __init__(self, fleet: Sequence[Vehicle], settings: TfSettings) -> None:
        """Advertise and subscribe.

        Args:
            fleet: the vehicles.
            settings: settings of the node.

        Raises:
            ValueError: a vehicle type cannot be used.
        """
        self._frame_id, self._body = settings.frame_id, settings.body
        self._new: dict[str, TransformStamped] = {}
        self._told: set[RobotFrames] = set()  # vehicles whose joint states have been received; others are at 0
        self._publisher = lockstep.Publisher("/tf", TFMessage)
        self._static = lockstep.Publisher("/tf_static", TFMessage, latch=True)
        self._robots: dict[str, _Robot] = {}
        self._models: dict[str, VehicleModel] = {}  # by vehicle type
        for vehicle in fleet:
            self._serve(vehicle)
        self._publish_fixed()
        FleetChanges(fleet, self._join, self._leave)

    def _serve(self, vehicle: Vehicle) -> None:
        name = vehicle.name
        if vehicle.model not in self._models:
            self._models[vehicle.model] = load_vehicle(vehicle.model)
        model = self._models[vehicle.model]
        frames = RobotFrames(name, model)
        pose_topic = f"/{name}/mavros/local_position/pose"
        subscribers = [lockstep.Subscriber(pose_topic, PoseStamped, partial(self._on_pose, frames))]
        if model.gimbal is not None or model.landing_gear:
            joints_topic = f"/{name}/joint_states"
            subscribers.append(lockstep.Subscriber(joints_topic, JointState, partial(self._on_joints, frames)))
        self._robots[name] = _Robot(frames, subscribers)

    def _publish_fixed(self) -> None:
        """Publish the fixed frames of all vehicles in one message, because a latched topic keeps only one."""
        fixed = [transform(frame, rospy.Time()) for robot in self._robots.values() for frame in robot.frames.fixed]
        self._static.publish(TFMessage(fixed))

    def _join(self, vehicle: Vehicle) -> None:
        self._serve(vehicle)
        self._publish_fixed()

    def _leave(self, vehicle: Vehicle) -> None:
        robot = self._robots.pop(vehicle.name)
        for subscriber in robot.subscribers:
            subscriber.unregister()
        self._told.discard(robot.frames)
        self._publish_fixed()

    def step(self) -> None:
        """Publish the transforms received since the last turn."""
        if self._new:
            self._publisher.publish(TFMessage(list(self._new.values())))
            self._new.clear()

    def _on_pose(self, frames: RobotFrames, message: PoseStamped) -> None:
        if self._body:
            p = message.pose.position
            place = Transform(Vector3(p.x, p.y, p.z), message.pose.orientation)
            header = Header(stamp=message.header.stamp, frame_id=self._frame_id)
            self._new[frames.body] = TransformStamped(header, frames.body, place)
        if frames not in self._told:
            self._place(frames.at_rest(), message.header.stamp)

    def _on_joints(self, frames: RobotFrames, message: JointState) -> None:
        self._told.add(frames)
        self._place(frames.at_angles(dict(zip(message.name, message.position, strict=True))), message.header.stamp)

    def _place(self, frames: Iterable[Frame], stamp: rospy.Time) -> None:
        for frame in frames:
            self._new[frame.child] = transform(frame, stamp)


def main(arguments: Sequence[str]) -> None:
    """Serve the fleet until shutdown.

    Raises:
        ArgumentError: invalid arguments, fleet or parameters.
    """
    check_no_arguments(arguments)
    fleet = needed_fleet(rospy.get_param("/xtdrone/fleet", None))
    try:
        for model in {vehicle.model for vehicle in fleet}:
            load_vehicle(model)
        settings = TfSettings.from_parameters(rospy.get_param, f"{lockstep.future_name('robot_tf')}/", names=("rate",))
    except (ModelError, ValueError) as error:
        raise ArgumentError(str(error)) from error
    lockstep.init_node("robot_tf", rate=settings.rate)
    settings = TfSettings.from_parameters(rospy.get_param)
    node = RobotTf(fleet, settings)
    lockstep.start()
    lockstep.spin(node.step)
