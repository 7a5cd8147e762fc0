"""A lockstep participant for tests: flies iris_0 by each kind of MAVROS's setpoints in turn.

It publishes on ``/pilot/flight`` (String, JSON) the true position (m, ENU) at the start and the end of each leg, and
finally the responses of the services.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator

import rospy
from gazebo_msgs.msg import ModelStates
from geographic_msgs.msg import GeoPoseStamped
from geometry_msgs.msg import PoseStamped, Quaternion, Transform, TwistStamped, Vector3, Vector3Stamped
from mavros_msgs.msg import AttitudeTarget, GlobalPositionTarget, ManualControl, Thrust
from mavros_msgs.srv import CommandBool, SetMode
from std_msgs.msg import String
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

import xtdrone_lockstep as lockstep
from xtdrone_common.geodesy.geoid import undulation

RATE = 50.0
MAVROS = "/iris_0/mavros/"
DATUM = (47.397742, 8.545594, 488.0)  # degrees, degrees, m AMSL
EARTH = 6371000.0  # m
GEOID = undulation(*DATUM[:2])
HEIGHT = 2.5  # m
TILT = 0.1  # rad
QUATERNION = "setpoint_attitude/use_quaternion"


def turned(pitch: float, yaw: float) -> Quaternion:
    """Return a ROS quaternion in FLU: a positive pitch is nose down."""
    cp, sp, cy, sy = math.cos(pitch / 2), math.sin(pitch / 2), math.cos(yaw / 2), math.sin(yaw / 2)
    return Quaternion(x=-sp * sy, y=sp * cy, z=cp * sy, w=cp * cy)


class Pilot:
    def __init__(self) -> None:
        self._flight = lockstep.Publisher("/pilot/flight", String, latch=True)
        self._attitude_topic = bool(rospy.get_param(MAVROS + QUATERNION, False))
        kinds = {
            "setpoint_raw/global": GlobalPositionTarget,
            "setpoint_attitude/thrust": Thrust,
            "setpoint_position/global": GeoPoseStamped,
            "setpoint_position/global_to_local": GeoPoseStamped,
            "setpoint_accel/accel": Vector3Stamped,
            "setpoint_trajectory/local": MultiDOFJointTrajectory,
            "manual_control/send": ManualControl,
        }
        if self._attitude_topic:
            kinds["setpoint_attitude/attitude"] = PoseStamped
        else:
            kinds["setpoint_attitude/cmd_vel"] = TwistStamped
        self._mouths = {topic: lockstep.Publisher(MAVROS + topic, kind) for topic, kind in kinds.items()}
        lockstep.Subscriber("/gazebo/model_states", ModelStates, self._see)
        lockstep.Subscriber(MAVROS + "setpoint_raw/target_attitude", AttitudeTarget, self._feel)
        lockstep.Subscriber(MAVROS + "manual_control/control", ManualControl, self._note)
        self._pose = self._twist = self._sticks = None
        self._thrust = 0.0
        self._legs: dict[str, object] = {}
        self._course = self._fly()

    def step(self) -> None:
        if self._pose is not None and self._course is not None and next(self._course, "end") == "end":
            self._course = None
            self._flight.publish(String(data=json.dumps(self._legs)))

    def _see(self, states: ModelStates) -> None:
        index = states.name.index("iris_0")
        self._pose, self._twist = states.pose[index], states.twist[index]

    def _feel(self, target: AttitudeTarget) -> None:
        self._thrust = target.thrust

    def _note(self, control: ManualControl) -> None:
        self._sticks = control

    def _place(self) -> tuple[float, float, float]:
        p = self._pose.position
        return p.x, p.y, p.z

    def _say(self, topic: str, message: object) -> None:
        message.header.stamp = rospy.Time.now()
        self._mouths[topic].publish(message)

    def _leg(self, name: str, seconds: float, say: Callable[[], None]) -> Iterator[None]:
        begin, until = self._place(), rospy.get_time() + seconds
        while rospy.get_time() < until:
            say()
            yield
        self._legs[name] = [begin, self._place()]

    def _fly(self) -> Iterator[None]:
        yield from self._leg("ground", 3.0, lambda: self._raw_global(0.0, 3.0))
        mode = rospy.ServiceProxy(MAVROS + "set_mode", SetMode)(custom_mode="OFFBOARD")
        arming = rospy.ServiceProxy(MAVROS + "cmd/arming", CommandBool)(value=True)
        self._legs["services"] = [mode.mode_sent, arming.success]
        yield from self._leg("raw global", 8.5, lambda: self._raw_global(2.0, 3.0))
        hover = self._thrust
        if self._attitude_topic:
            yield from self._leg("attitude east", 1.5, lambda: self._tilt(hover, TILT, 0.0))
            yield from self._leg("attitude north", 1.5, lambda: self._tilt(hover, TILT, math.pi / 2))
        else:
            yield from self._leg("rates", 2.0, lambda: self._turn(hover, 0.5))
        yield from self._leg("global", 4.0, lambda: self._say("setpoint_position/global", self._geo(0.0, 6.0)))
        goal = "setpoint_position/global_to_local"
        yield from self._leg("global to local", 4.0, lambda: self._say(goal, self._geo(2.0, 4.0, GEOID)))
        yield from self._leg("acceleration", 1.0, lambda: self._accelerate((0.0, 1.0, 0.0)))
        x, y, z = self._place()
        self._draw([(x + 0.1 * i, y, z) for i in range(21)])
        yield from self._leg("trajectory", 2.5, lambda: None)
        yield from self._leg("hands on", 0.5, lambda: self._push(0.0))
        self._legs["pilot"] = [rospy.ServiceProxy(MAVROS + "set_mode", SetMode)(custom_mode="POSCTL").mode_sent]
        yield from self._leg("sticks", 2.0, lambda: self._push(300.0))
        self._legs["followed"] = [self._sticks.x, self._sticks.z]

    def _geo(self, east: float, north: float, geoid: float = 0.0) -> GeoPoseStamped:
        """Return a goal above mean sea level or, with the ``geoid``'s height, m, above the ellipsoid."""
        message = GeoPoseStamped()
        place = message.pose.position
        place.latitude, place.longitude = latitude_longitude(east, north)
        place.altitude = DATUM[2] + HEIGHT + geoid
        message.pose.orientation = turned(0.0, 0.0)
        return message

    def _raw_global(self, east: float, north: float) -> None:
        latitude, longitude = latitude_longitude(east, north)
        message = GlobalPositionTarget(
            coordinate_frame=GlobalPositionTarget.FRAME_GLOBAL_INT, type_mask=0b1001_1111_1000
        )
        message.latitude, message.longitude, message.altitude = latitude, longitude, DATUM[2] + HEIGHT
        self._say("setpoint_raw/global", message)

    def _lift(self, hover: float) -> None:
        """Hold the height by thrust."""
        thrust = hover + 0.08 * (HEIGHT - self._pose.position.z) - 0.08 * self._twist.linear.z
        self._say("setpoint_attitude/thrust", Thrust(thrust=min(max(thrust, 0.0), 1.0)))

    def _tilt(self, hover: float, pitch: float, yaw: float) -> None:
        message = PoseStamped()
        message.pose.orientation = turned(pitch, yaw)
        self._say("setpoint_attitude/attitude", message)
        self._lift(hover)

    def _turn(self, hover: float, rate: float) -> None:
        message = TwistStamped()
        message.twist.angular.z = rate
        self._say("setpoint_attitude/cmd_vel", message)
        self._lift(hover)

    def _accelerate(self, acceleration: tuple[float, float, float]) -> None:
        self._say("setpoint_accel/accel", Vector3Stamped(vector=Vector3(*acceleration)))

    def _push(self, x: float) -> None:
        self._say("manual_control/send", ManualControl(x=x, z=500.0))

    def _draw(self, places: list[tuple[float, float, float]]) -> None:
        message = MultiDOFJointTrajectory()
        for index, place in enumerate(places):
            point = MultiDOFJointTrajectoryPoint(time_from_start=rospy.Duration.from_sec(0.1 * index))
            point.transforms = [Transform(Vector3(*place), turned(0.0, 0.0))]
            message.points.append(point)
        self._say("setpoint_trajectory/local", message)


def latitude_longitude(east: float, north: float) -> tuple[float, float]:
    longitude = DATUM[1] + math.degrees(east / EARTH / math.cos(math.radians(DATUM[0])))
    return DATUM[0] + math.degrees(north / EARTH), longitude


def main() -> None:
    lockstep.init_node("pilot", rate=RATE)
    pilot = Pilot()
    lockstep.start()
    lockstep.spin(pilot.step)


if __name__ == "__main__":
    main()
