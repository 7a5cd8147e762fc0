"""Direct the landing of a UAV on a ground robot that drives: takeoff, search, and PX4's precision landing.

=============================  ====================================  ==================================================
topic                          type                                  meaning
=============================  ====================================  ==================================================
/T/tag_detections              apriltag_ros/AprilTagDetectionArray   in: whether the platform is in sight
/ROBOT/odom                    nav_msgs/Odometry                     in: the clock of the robot's commands
/ROBOT/cmd_vel                 geometry_msgs/Twist                   out: the robot drives at a fixed speed and yaw rate
/xtdrone/demo/events           std_msgs/String                       out: JSON, as in events.jsonl
/xtdrone/demo/progress         std_msgs/String                       out: JSON
=============================  ====================================  ==================================================

The director does not tell the UAV where the robot is: it only knows where the search is to begin.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import rospy
from apriltag_ros.msg import AprilTagDetectionArray
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry

import xtdrone_lockstep as lockstep
from xtdrone_common.settings import Settings, setting
from xtdrone_control.drone import Drone, DroneError
from xtdrone_interaction.missions.director import FlightReporter

PHASES = ("takeoff", "search", "landing", "on the platform")
_STEP = 0.1  # s between looks at the detections
_SIGHTINGS, _WITHIN = 3, 1.0  # detections within this time, s, that begin the landing
_WATCH = 15.0  # s at the place of the search, past which the robot may come, before the spirals
_TURNS = 2.5  # of a spiral, which then begins again in the middle
_RIDE = 2.0  # s on the platform before the end
_LAST_TURNS = 10


@dataclass(frozen=True)
class LandingSettings(Settings):
    """Private parameters of the director."""

    robot: str = setting("ugv_0", text="robot to land on")
    ugv_speed: float = setting(1.0, low=0.0, high=1.4, unit="m/s", text="speed of the robot")
    ugv_turn: float = setting(0.0, low=-0.3, high=0.3, unit="rad/s", text="yaw rate of the robot")
    height: float = setting(4.0, low=2.0, high=6.0, unit="m", text="height of the search")
    speed: float = setting(2.5, low=0.5, high=4.0, unit="m/s", text="speed of the search")
    time_limit: float = setting(
        180.0, low=10.0, high=3600.0, unit="s", text="simulated time after which the UAV just lands"
    )
    out: str = setting("", text="folder for events.jsonl, empty for none")


@dataclass
class Spiral:
    """A point that moves outwards on an Archimedean spiral at a fixed speed.

    Attributes:
        x, y: Middle, m.
        pitch: Distance of two turns, m.
        speed: Speed of the point, m/s.
        widest: Radius at which it begins again, m.
        angle: Angle turned so far, rad.
    """

    x: float
    y: float
    pitch: float
    speed: float
    widest: float
    angle: float = 0.0

    @property
    def point(self) -> tuple[float, float]:
        """The current point, m."""
        radius = self.pitch * self.angle / math.tau
        return self.x + radius * math.cos(self.angle), self.y + radius * math.sin(self.angle)

    def advance(self, dt: float) -> tuple[float, float]:
        """Move on by ``dt`` s and return the velocity, m/s.

        With r = c phi the speed is c sqrt(1 + phi^2) times the rate of phi.
        """
        slope = self.pitch / math.tau
        if slope * self.angle > self.widest:
            self.angle = 0.0
        rate = self.speed / (slope * math.hypot(1.0, self.angle))
        rate = min(rate, 2.0)  # rad/s, in the middle
        radius, phi = slope * self.angle, self.angle
        self.angle += rate * dt
        return (
            rate * (slope * math.cos(phi) - radius * math.sin(phi)),
            rate * (slope * math.sin(phi) + radius * math.cos(phi)),
        )


class LandingDirector:
    """Directs one landing; ``run`` after ``connect``, which has started the node."""

    def __init__(self, name: str, settings: LandingSettings) -> None:
        """Declare the topics, before the vehicle is connected.

        Args:
            name: Name of the UAV.
            settings: Settings of the landing.

        Raises:
            OSError: the events file cannot be written.
        """
        self._settings = settings
        self.reporter = FlightReporter(settings.out)
        self._sightings: deque[float] = deque(maxlen=_SIGHTINGS)
        self._drives = False
        self._phase = PHASES[0]
        self._command = lockstep.Publisher(f"/{settings.robot}/cmd_vel", Twist)
        lockstep.Subscriber(f"/{name}/tag_detections", AprilTagDetectionArray, self._on_detections)
        lockstep.Subscriber(f"/{settings.robot}/odom", Odometry, self._on_odometry)

    def run(self, drone: Drone) -> bool:
        """Fly, and return whether the UAV has landed on a target that it saw."""
        self.reporter.event("started", ugv_speed=self._settings.ugv_speed, ugv_turn=self._settings.ugv_turn)
        drone.arm()
        drone.takeoff(self._settings.height)
        self._drives = True
        self._enter("search")
        found = self._search(drone)
        if found:
            self.reporter.event("tags found", after=rospy.get_time())
            self._enter("landing")
            found = self._land(drone)
        else:
            self.reporter.event("no tags found")
            drone.land()
        self._enter("on the platform" if found else "landed elsewhere")
        self._wait(drone, _RIDE)
        return found

    def conclude(self, drone: Drone | None, outcome: str, reason: str = "") -> None:
        """Publish the last event and give subscribers time to receive it."""
        self.reporter.event("finished", outcome=outcome, reason=reason)
        if drone is not None and not rospy.is_shutdown():
            drone.wait(_LAST_TURNS * _STEP)

    def _search(self, drone: Drone) -> bool:
        """Watch the place, then fly spirals, until the tags are in sight; return whether they are."""
        x, y, z = drone.position.tolist()
        pitch = 1.2 * self._settings.height  # the picture is wider
        spiral = Spiral(x, y, pitch, self._settings.speed, _TURNS * pitch)
        watched = rospy.get_time() + _WATCH
        while not self._in_sight():
            if rospy.get_time() > self._settings.time_limit:
                return False
            vx, vy = spiral.advance(_STEP) if rospy.get_time() > watched else (0.0, 0.0)
            px, py = spiral.point
            here = drone.position.tolist()
            drone.set_velocity(vx + 0.5 * (px - here[0]), vy + 0.5 * (py - here[1]), 0.8 * (z - here[2]))
            self._wait(drone, _STEP)
        return True

    def _land(self, drone: Drone) -> bool:
        """Land on the tags; return whether the mode was kept to the end."""
        drone.set_mode("AUTO.PRECLAND")
        while drone.armed:
            if drone.mode != "AUTO.PRECLAND" or rospy.get_time() > self._settings.time_limit:
                self.reporter.event("landing given up", mode=drone.mode)
                drone.land()
                return False
            self._wait(drone, _STEP)
        return True

    def _wait(self, drone: Drone, seconds: float) -> None:
        drone.wait(seconds)
        step = PHASES.index(self._phase) + 1 if self._phase in PHASES else len(PHASES)
        self.reporter.progress(self._phase, step, len(PHASES))

    def _in_sight(self) -> bool:
        return len(self._sightings) == _SIGHTINGS and rospy.get_time() - self._sightings[0] <= _WITHIN

    def _enter(self, phase: str) -> None:
        self._phase = phase
        self.reporter.event("phase", phase=phase)

    def _on_detections(self, message: AprilTagDetectionArray) -> None:
        if message.detections:
            self._sightings.append(message.header.stamp.to_sec())

    def _on_odometry(self, _: Odometry) -> None:
        if self._drives:
            command = Twist()
            command.linear.x, command.angular.z = self._settings.ugv_speed, self._settings.ugv_turn
            self._command.publish(command)


def direct(director: LandingDirector, drone: Drone) -> int:
    """Run the landing to its end and return the exit status."""
    try:
        landed = director.run(drone)
    except DroneError as error:
        rospy.logerr("landing: %s", error)
        director.conclude(None, "failed", str(error))
        return 1
    director.conclude(drone, "landed" if landed else "missed")
    return 0 if landed else 1
