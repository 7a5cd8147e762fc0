"""A program like those of XTDrone's users: rospy only, outside the lockstep; an attitude controller flies iris_0.

Its PositionTarget has no frame (0), as that of XTDrone's attitude demo. After takeoff it flies to 1 m east by
attitudes, back by body rates, and then repeats one offset forward of the vehicle (frame 9) as XTDrone's communication
node does. It publishes on ``/demo/flight`` (String, JSON) the position at the end of each leg, m ENU.
"""

from __future__ import annotations

import json
import math
import queue
from collections.abc import Callable

import rospy
from geometry_msgs.msg import PoseStamped, TwistStamped
from mavros_msgs.msg import AttitudeTarget, PositionTarget
from mavros_msgs.srv import CommandBool, SetMode
from std_msgs.msg import String

MAVROS = "/iris_0/mavros/"
HEIGHT = 2.0  # m
NEAR = 0.15  # m
LIMIT = 15.0  # s of simulated time for one leg
TILT = 0.25  # rad, at most
BODY_OFFSET = 9
ONLY_POSITION_YAW = (
    PositionTarget.IGNORE_VX
    + PositionTarget.IGNORE_VY
    + PositionTarget.IGNORE_VZ
    + PositionTarget.IGNORE_AFX
    + PositionTarget.IGNORE_AFY
    + PositionTarget.IGNORE_AFZ
    + PositionTarget.FORCE
    + PositionTarget.IGNORE_YAW_RATE
)


class Demo:
    """Publishes one setpoint for each received pose."""

    def __init__(self) -> None:
        self._poses: queue.SimpleQueue[PoseStamped] = queue.SimpleQueue()
        self._velocity = (0.0, 0.0, 0.0)  # m/s FLU
        self._hover = 0.5
        self._legs: dict[str, object] = {}
        self._target = rospy.Publisher(MAVROS + "setpoint_raw/local", PositionTarget, queue_size=10)
        self._attitude = rospy.Publisher(MAVROS + "setpoint_raw/attitude", AttitudeTarget, queue_size=2)
        self._flight = rospy.Publisher("/demo/flight", String, queue_size=1, latch=True)
        rospy.Subscriber(MAVROS + "setpoint_raw/target_attitude", AttitudeTarget, self._feel)
        rospy.Subscriber(MAVROS + "local_position/velocity_body", TwistStamped, self._move)
        rospy.Subscriber(MAVROS + "local_position/pose", PoseStamped, self._poses.put)

    def _move(self, twist: TwistStamped) -> None:
        v = twist.twist.linear
        self._velocity = v.x, v.y, v.z

    def _feel(self, target: AttitudeTarget) -> None:
        self._hover = target.thrust

    def fly(self) -> None:
        self._leg("ground", lambda _: self._position(0, 0.0, 0.0, HEIGHT), until=2.0)
        mode = rospy.ServiceProxy(MAVROS + "set_mode", SetMode)(custom_mode="OFFBOARD")
        arming = rospy.ServiceProxy(MAVROS + "cmd/arming", CommandBool)(value=True)
        self._legs["services"] = [mode.mode_sent, arming.success]
        self._leg("position", lambda _: self._position(0, 0.0, 0.0, HEIGHT), goal=(0.0, 0.0, HEIGHT))
        hover = self._hover
        self._leg("attitude", lambda pose: self._steer(pose, hover, 1.0, rates=False), goal=(1.0, 0.0, HEIGHT))
        self._leg("rates", lambda pose: self._steer(pose, hover, 0.0, rates=True), goal=(0.0, 0.0, HEIGHT))
        self._leg("hold", lambda _: self._position(0, 0.0, 0.0, HEIGHT), until=2.0)
        self._leg("offset", lambda _: self._position(BODY_OFFSET, 2.0, 0.0, 0.0), until=8.0)
        self._flight.publish(String(data=json.dumps(self._legs)))

    def _leg(
        self,
        name: str,
        publish: Callable[[PoseStamped], None],
        *,
        goal: tuple[float, float, float] | None = None,
        until: float = LIMIT,
    ) -> None:
        """Publish a setpoint for each pose, until the goal is reached or some seconds have passed."""
        begin = None
        while True:
            pose = self._poses.get()
            while not self._poses.empty():
                pose = self._poses.get()
            now = pose.header.stamp.to_sec()
            begin = now if begin is None else begin
            publish(pose)
            p = pose.pose.position
            here = p.x, p.y, p.z
            there = goal is not None and math.dist(here, goal) < NEAR and math.dist(self._velocity, (0, 0, 0)) < NEAR
            if there or now - begin > until:
                self._legs[name] = here
                return

    def _position(self, frame: int, x: float, y: float, z: float) -> None:
        target = PositionTarget(coordinate_frame=frame, type_mask=ONLY_POSITION_YAW)
        target.position.x, target.position.y, target.position.z = x, y, z
        self._target.publish(target)

    def _steer(self, pose: PoseStamped, hover: float, x: float, *, rates: bool) -> None:
        """Tilt towards (x, 0, HEIGHT) and hold the heading, east."""
        p, q = pose.pose.position, pose.pose.orientation
        vx, vy, vz = self._velocity
        roll = math.atan2(2.0 * (q.w * q.x + q.y * q.z), 1.0 - 2.0 * (q.x * q.x + q.y * q.y))
        pitch = math.asin(2.0 * (q.w * q.y - q.z * q.x))
        yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
        wanted_pitch = min(TILT, max(-TILT, 0.2 * (x - p.x) - 0.2 * vx))
        wanted_roll = min(TILT, max(-TILT, 0.2 * p.y + 0.2 * vy))
        target = AttitudeTarget(thrust=hover + 0.1 * (HEIGHT - p.z) - 0.1 * vz)
        if rates:
            target.type_mask = AttitudeTarget.IGNORE_ATTITUDE
            target.body_rate.x, target.body_rate.y = 3.0 * (wanted_roll - roll), 3.0 * (wanted_pitch - pitch)
            target.body_rate.z = -yaw
        else:
            target.type_mask = (
                AttitudeTarget.IGNORE_ROLL_RATE + AttitudeTarget.IGNORE_PITCH_RATE + AttitudeTarget.IGNORE_YAW_RATE
            )
            cr, sr, cp, sp = (f(0.5 * a) for a in (wanted_roll, wanted_pitch) for f in (math.cos, math.sin))
            o = target.orientation
            o.w, o.x, o.y, o.z = cr * cp, sr * cp, cr * sp, -sr * sp
        self._attitude.publish(target)


if __name__ == "__main__":
    rospy.init_node("attitude_demo")
    Demo().fly()
    rospy.spin()
