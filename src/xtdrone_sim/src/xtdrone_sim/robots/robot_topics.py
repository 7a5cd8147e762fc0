"""Topics of the robots, where NAME is a robot's name, such as ugv_0; boats have no joints.

==========================  ===========================  ==============================================================
NAME/cmd_vel (in)           geometry_msgs/Twist          linear.x: speed, m/s; angular.z: yaw rate, rad/s, of a car the
                                                         steering angle, rad, as for XTDrone's catvehicle
NAME/odom                   nav_msgs/Odometry            from the wheels, without error: NAME/odom -> NAME/base_link
NAME/joint_states           sensor_msgs/JointState       wheels and steering
/tf                         tf2_msgs/TFMessage           NAME/odom -> NAME/base_link -> wheels, as left_wheel
/tf_static                  tf2_msgs/TFMessage           map -> NAME/odom, NAME/base_link -> NAME/platform
==========================  ===========================  ==============================================================

The rate is 50 Hz of simulated time; nothing is computed without subscribers. The frame ``odom`` is the robot's start
pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import rospy
from geometry_msgs.msg import (
    Point,
    PoseWithCovariance,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from geometry_msgs.msg import Pose as PoseMessage
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

import xtdrone_lockstep as lockstep
from xtdrone_common.frames import to_xyzw
from xtdrone_common.poses import Pose, compose, inverse
from xtdrone_sim.gazebo.models_by_name import Models
from xtdrone_sim.gazebo.scene_topics import ModelTopics
from xtdrone_sim.physics.contacts.start_collisions import StartError, check_height
from xtdrone_sim.rays.solid_ground import SolidGround, shapes_of
from xtdrone_sim.robots.boat_dynamics import Boat
from xtdrone_sim.robots.wheel_drives import Drive, drive_of
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.topics.link_topics import PERIOD_US
from xtdrone_worlds.worlds.robots.list_of_robots import Robot
from xtdrone_worlds.worlds.robots.robot_model import LINK, BoatModel
from xtdrone_worlds.worlds.robots.robot_urdf import urdf_of, wheel_frames

_WARNING_PERIOD = 5.0  # wall s between two equal warnings
_TOLERANCE = 0.01  # m of overlap at the start
_EXACT = 1e-9  # m^2, rad^2 and their rates: covariance of odometry without error, which filters divide by


class RobotTopics:
    """The robots of a simulation; all methods are called in the simulator's thread."""

    def __init__(self, robots: Sequence[Robot], simulation: Simulation, models: Models, shown: ModelTopics) -> None:
        """Place the robots in the world, advertise and subscribe; called after ``lockstep.host()``.

        Args:
            robots: names, types and start poses.
            simulation: simulation with the world in which they drive.
            models: all models, to which they are added.
            shown: notifies cameras and lidars of them.

        Raises:
            ValueError: a name is taken, or a place is not free.
        """
        self._robots, self._simulation, self._models, self._shown = robots, simulation, models, shown
        self._drives: dict[str, Drive | Boat] = {}
        self._numbers: dict[str, int] = {}
        self._published_us = -1
        for robot in robots:
            if robot.name in models.present:
                raise ValueError(f"robots: {robot.name!r} is the name of a vehicle or of a model in the world")
        self._enter()
        self._odometry = {robot.name: lockstep.Publisher(f"/{robot.name}/odom", Odometry) for robot in robots}
        self._joints = {robot.name: lockstep.Publisher(f"/{robot.name}/joint_states", JointState) for robot in robots}
        for robot in robots:
            lockstep.Subscriber(f"/{robot.name}/cmd_vel", Twist, partial(self._on_command, robot.name))
            rospy.set_param(f"/{robot.name}/robot_description", urdf_of(robot.name, robot.model))
        if robots:
            self._tf = lockstep.Publisher("/tf", TFMessage)
            self._static = lockstep.Publisher("/tf_static", TFMessage, latch=True)
            self._static.publish(TFMessage(self._fixed_frames()))

    def _enter(self) -> None:
        """Move all robots to their start poses.

        Raises:
            StartError: a place is not free.
        """
        world = self._simulation.world
        ground = SolidGround(shapes_of(world.model.models)) if self._robots else None
        self._starts: dict[str, Pose] = {}
        for robot in self._robots:
            is_boat = isinstance(robot.model, BoatModel)
            has_terrain = ground is not None and ground.has_terrain and not is_boat
            start = _on_terrain(robot, ground) if has_terrain and ground is not None else robot.pose
            drive = drive_of(robot.model, start, None if ground is None or ground.is_level else ground)
            if isinstance(drive, Boat):
                start = drive.state.pose
                drive.follow_clock(lambda: self._simulation.time_us * 1e-6)
            pose = self._starts[robot.name] = start if drive.is_level else drive.state.pose
            self._drives[robot.name] = drive
            self._numbers[robot.name] = self._models.enter(robot.model.model(robot.name, pose), drive)
        names = [*self._simulation.names, *self._models.names]
        for robot in self._robots:
            for other, depth in world.overlaps(self._numbers[robot.name]):
                if depth > _TOLERANCE:
                    x, y, _ = robot.pose.position
                    place = f"the start at {x:g} {y:g} m is not free"
                    raise StartError(f"{robot.name}: {place}: it is {depth:.2f} m inside {names[other]}")
        if self._robots:
            self._shown.announce()

    def restart(self) -> None:
        """Move all robots to their start poses after a restart of the simulation."""
        self._published_us = -1
        self._enter()

    def _on_command(self, name: str, message: Twist) -> None:
        drive, bodies = self._drives[name], self._simulation.world.bodies
        if self._numbers[name] not in bodies.by_number:
            rospy.logwarn_throttle(_WARNING_PERIOD, f"simulator: /{name}/cmd_vel: {name} has been deleted")
            return
        try:
            drive.command(message.linear.x, message.angular.z)
        except ValueError as error:
            rospy.logwarn_throttle(_WARNING_PERIOD, f"simulator: /{name}/cmd_vel: {error}")
            return
        if not drive.is_still:
            bodies.wake(self._numbers[name])

    def _has_subscribers(self) -> bool:
        if not self._robots:
            return False
        publishers = [self._tf, *self._odometry.values(), *self._joints.values()]
        return any(publisher.get_num_connections() for publisher in publishers)

    def next_publication_us(self, now_us: int) -> int | None:
        """Return the next publication time, microseconds; None without subscribers."""
        return now_us - now_us % PERIOD_US + PERIOD_US if self._has_subscribers() else None

    def publish(self) -> None:
        """Publish to all topics with subscribers if the current time is a publication time."""
        now = self._simulation.time_us
        if now % PERIOD_US or now == self._published_us or not self._has_subscribers():
            return
        self._published_us = now
        stamp, frames = rospy.Time(0, now * 1000), []
        there = self._simulation.world.bodies.by_number
        for robot in self._robots:
            if self._numbers[robot.name] not in there:
                continue
            drive = self._drives[robot.name]
            pose = compose(inverse(self._starts[robot.name]), drive.state.pose)
            frames.append(_transform(stamp, f"{robot.name}/odom", f"{robot.name}/{LINK}", pose))
            frames += [
                _transform(stamp, f"{robot.name}/{parent}", f"{robot.name}/{child}", place)
                for parent, child, place in wheel_frames(robot.model, drive.joints())
            ]
            if self._odometry[robot.name].get_num_connections():
                self._odometry[robot.name].publish(_odometry(stamp, robot.name, pose, drive))
            if self._joints[robot.name].get_num_connections():
                joints = drive.joints()
                names, angles, rates = ([joint[k] for joint in joints] for k in range(3))
                self._joints[robot.name].publish(JointState(Header(stamp=stamp), names, angles, rates, []))
        if self._tf.get_num_connections():
            self._tf.publish(TFMessage(frames))

    def _fixed_frames(self) -> list[TransformStamped]:
        frames = []
        for robot in self._robots:
            frames.append(_transform(rospy.Time(), "map", f"{robot.name}/odom", self._starts[robot.name]))
            deck = robot.model.platform
            if deck is not None:
                place = Pose((robot.model.ahead, 0.0, deck.height))
                frames.append(_transform(rospy.Time(), f"{robot.name}/{LINK}", f"{robot.name}/platform", place))
        return frames


def _on_terrain(robot: Robot, ground: SolidGround) -> Pose:
    """Return the start pose of a robot at the height of the terrain there, unless its own is given.

    Raises:
        StartError: the given height is below the terrain.
    """
    x, y, z = robot.pose.position
    middle = np.array([[x, y]])
    if robot.has_height:
        check_height(ground, middle, z, robot.name)
        return robot.pose
    return Pose((x, y, max(z, float(ground.terrain(middle)[0]))), robot.pose.orientation)


def _transform(stamp: rospy.Time, parent: str, child: str, pose: Pose) -> TransformStamped:
    turn = Quaternion(*to_xyzw(pose.orientation))
    return TransformStamped(Header(stamp=stamp, frame_id=parent), child, Transform(Vector3(*pose.position), turn))


def _odometry(stamp: rospy.Time, name: str, pose: Pose, drive: Drive | Boat) -> Odometry:
    placed = PoseMessage(Point(*pose.position), Quaternion(*to_xyzw(pose.orientation)))
    velocity, spin = drive.twist
    twist = Twist(Vector3(*velocity), Vector3(*spin))
    exact = [_EXACT if k % 7 == 0 else 0.0 for k in range(36)]
    header = Header(stamp=stamp, frame_id=f"{name}/odom")
    return Odometry(header, f"{name}/{LINK}", PoseWithCovariance(placed, exact), TwistWithCovariance(twist, exact))
