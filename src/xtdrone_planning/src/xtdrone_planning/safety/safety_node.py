"""The safety filter as the last node before MAVROS.

With the parameter ``/xtdrone/setpoint_namespace`` (``safety``) the MAVROS layer subscribes to setpoints below
``/T/safety`` in place of ``/T/mavros``. Nodes publish as usual; the filter subscribes to their setpoints and forwards
them. For a real MAVROS, remap each topic. For each vehicle ``T``:

=======================================  ================================  ============================================
topic                                    type                              meaning
=======================================  ================================  ============================================
/T/mavros/setpoint_raw/local             mavros_msgs/PositionTarget        in; as are the next four
/T/mavros/setpoint_position/local        geometry_msgs/PoseStamped
/T/mavros/setpoint_velocity/cmd_vel      geometry_msgs/TwistStamped        and cmd_vel_unstamped (Twist)
/T/mavros/setpoint_accel/accel           geometry_msgs/Vector3Stamped
/T/safety/...                            as above                          out: setpoints that are allowed, unchanged
/T/safety/setpoint_raw/local             mavros_msgs/PositionTarget        out: all corrected ones, as velocities
/T/safety/intervention                   xtdrone_msgs/SafetyIntervention   out: every correction, and its end
/T/mavros/local_position/pose            geometry_msgs/PoseStamped         in: of this vehicle, and of all others with
/T/mavros/local_position/velocity_local  geometry_msgs/TwistStamped        this, or /xtdrone/swarm for all at once
/T/mavros/extended_state                 mavros_msgs/ExtendedState         in: a vehicle on the ground is not filtered
/T/CLOUD                                 sensor_msgs/PointCloud2           in: obstacles, if ``~cloud`` names it
/T/planner/trajectory                    xtdrone_msgs/SplineTrajectory     in: of all; see ``flown_trajectories``
/diagnostics                             diagnostic_msgs/DiagnosticArray   out: once a second
=======================================  ================================  ============================================
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import rospy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped, Vector3, Vector3Stamped
from mavros_msgs.msg import PositionTarget
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray
from xtdrone_msgs.msg import SafetyIntervention, SplineTrajectory

import xtdrone_lockstep as lockstep
from xtdrone_common import rotation
from xtdrone_common.clouds import ScanError, points_of
from xtdrone_common.programs.node_command_line import ArgumentError, needed_fleet, run_program
from xtdrone_control.vehicle_program import run_node
from xtdrone_control.vehicle_topics import VehicleTopics
from xtdrone_planning.safety.near_points import place_points, without_vehicles
from xtdrone_planning.safety.setpoints import (
    Gains,
    Meaning,
    VehicleMotion,
    fill_target,
    meaning_of_acceleration,
    meaning_of_pose,
    meaning_of_target,
    meaning_of_twist,
)
from xtdrone_planning.safety.trajectory_clearance import TrajectoryClearance
from xtdrone_planning.safety.velocity_filter import SafetySettings, VelocityFilter, Verdict
from xtdrone_planning.trajectories.flown_trajectories import FlownTrajectories
from xtdrone_planning.trajectories.trajectory_messages import TrajectoryError, spline_of

FIELDS = 6  # numbers a vehicle in the message of all: x, y, z, vx, vy, vz; m, m/s, ENU


class SwarmPositions:
    """Positions and velocities of N vehicles, and the times of their reception.

    Attributes:
        positions: shape (N, 3), m ENU; NaN: never received.
        velocities: shape (N, 3), m/s ENU; 0: never received.
        heard: times of reception, shape (N,), s.
    """

    def __init__(self, count: int) -> None:
        """Start without data about ``count`` vehicles."""
        self.positions = np.full((count, 3), np.nan)
        self.velocities = np.zeros((count, 3))
        self.heard = np.full(count, -np.inf)

    def restart(self) -> None:
        """Forget everything."""
        self.positions[:], self.velocities[:], self.heard[:] = np.nan, 0.0, -np.inf

    def on_position(self, index: int, position: Sequence[float], now: float) -> None:
        """Store a position (m ENU) received now (s), unless it is not finite."""
        if np.all(np.isfinite(position)):
            self.positions[index], self.heard[index] = position, now

    def on_velocity(self, index: int, velocity: Sequence[float]) -> None:
        """Store a velocity (m/s ENU), unless it is not finite."""
        if np.all(np.isfinite(velocity)):
            self.velocities[index] = velocity

    def on_all(self, numbers: Sequence[float], now: float) -> None:
        """Store the states of all vehicles, FIELDS numbers each; those that are not finite are ignored.

        Raises:
            ValueError: the number of values is wrong.
        """
        rows = np.array(numbers, dtype=np.float64)
        if len(rows) != FIELDS * len(self.heard):
            raise ValueError(f"{len(rows)} numbers are not allowed, {FIELDS} for each of {len(self.heard)} vehicles")
        rows = rows.reshape(-1, FIELDS)
        valid = np.isfinite(rows).all(axis=1)
        self.positions[valid], self.velocities[valid], self.heard[valid] = rows[valid, :3], rows[valid, 3:], now

    def at(self, now: float, longest: float) -> NDArray[np.float64]:
        """Return the current positions, shape (N, 3), m: each extrapolated with its velocity, for at most ``longest``
        s."""
        age = np.clip(np.where(np.isfinite(self.heard), now - self.heard, 0.0), 0.0, longest)
        moved: NDArray[np.float64] = self.positions + self.velocities * age[:, None]
        return moved

    def old(self, now: float, timeout: float) -> list[int]:
        """Return the vehicles whose position is older than ``timeout`` s."""
        return [int(i) for i in np.flatnonzero(now - self.heard > timeout)]


RATE = 30  # Hz
USAGE = "safety_filter.py [VEHICLE ...]   (as iris_0; default: all of /xtdrone/fleet)"
NAMESPACE = "safety"

_TARGET = "setpoint_raw/local"
_HOLD = 0.5  # s for which a setpoint remains in force; after that the autopilot's own timeout applies
_REPORT_PERIOD = 1.0  # s
_PATH_LENGTH = 100  # poses kept, to transform clouds by the pose at their time
_MAP_FRAMES = ("map", "/map")
_NO_POINTS = np.empty((0, 3))


class GuardedVehicle:
    """Filter of one vehicle's setpoints."""

    def __init__(
        self,
        names: Sequence[str],
        index: int,
        swarm: SwarmPositions,
        trajectories: FlownTrajectories,
        settings: SafetySettings,
    ) -> None:
        """Declare the topics.

        Args:
            names: Names of all vehicles.
            index: Index of this one.
            swarm: positions of all vehicles.
            trajectories: Trajectories of all vehicles.
            settings: Settings of the filter.
        """
        self.name = name = names[index]
        self._names, self._index, self._swarm, self._settings = names, index, swarm, settings
        self._trajectories, self._clearance = trajectories, TrajectoryClearance()
        self._others = [i for i in range(len(names)) if i != index]
        self._filter = VelocityFilter(settings, 1.0 / RATE)
        self._gains = Gains(settings.kp, settings.lag, settings.max_speed)
        self._mount = np.array(settings.mount[:3]), rotation.from_euler(*settings.mount[3:])
        self._target, self._intervention = PositionTarget(), SafetyIntervention()
        self._outputs = {}
        for topic, kind, meaning in (
            (_TARGET, PositionTarget, self._of_target),
            ("setpoint_position/local", PoseStamped, self._of_pose),
            ("setpoint_velocity/cmd_vel", TwistStamped, lambda message: meaning_of_twist(message.twist)),
            ("setpoint_velocity/cmd_vel_unstamped", Twist, meaning_of_twist),
            ("setpoint_accel/accel", Vector3Stamped, self._of_acceleration),
        ):
            self._outputs[topic] = lockstep.Publisher(f"/{name}/{NAMESPACE}/{topic}", kind)
            lockstep.Subscriber(f"/{name}/mavros/{topic}", kind, partial(self._on_setpoint, topic, meaning))
        self._report = lockstep.Publisher(f"/{name}/{NAMESPACE}/intervention", SafetyIntervention)
        self._vehicle = VehicleTopics(name, "pose", "extended_state", on_pose=self._on_pose)
        if settings.cloud:
            lockstep.Subscriber(f"/{name}/{settings.cloud}", PointCloud2, self._on_cloud)
        self._forget()

    def restart(self) -> None:
        """Begin again, because simulated time was reset."""
        self._filter.restart()
        self._forget()

    def _forget(self) -> None:
        self._path: deque[tuple[float, NDArray[np.float64]]] = deque(maxlen=_PATH_LENGTH)  # s, pose
        self._setpoint: tuple[str, Callable[[Any], Meaning | None], Any] | None = None
        self._came, self._fresh = -np.inf, False
        self._points, self._points_time = _NO_POINTS, -np.inf
        self._verdict: Verdict | None = None
        self._corrections = self._unchecked = 0

    # messages

    def _on_setpoint(self, topic: str, meaning: Callable[[Any], Meaning | None], message: Any) -> None:
        self._setpoint, self._fresh = (topic, meaning, message), True

    def _on_pose(self, stamp: rospy.Time, pose: NDArray[np.float64]) -> None:
        self._path.append((stamp.to_sec(), pose))

    def _on_cloud(self, message: PointCloud2) -> None:
        try:
            records = points_of(message)
        except ScanError as error:
            rospy.logwarn_throttle_identical(5.0, f"{self.name}: {self._settings.cloud}: {error}; ignored")
            return
        points = np.stack([records[axis] for axis in "xyz"], axis=1).astype(np.float64)
        stamp = message.header.stamp.to_sec()
        if message.header.frame_id not in _MAP_FRAMES:
            if not self._path:
                return
            _, pose = min(self._path, key=lambda entry: abs(entry[0] - stamp))
            attitude = tuple(pose[3:].tolist())
            points = place_points(points, *self._mount, pose[:3].copy(), attitude, self._settings.range)
        self._points, self._points_time = self._without_others(points, stamp), stamp

    def _without_others(self, points: NDArray[np.float64], stamp: float) -> NDArray[np.float64]:
        """Return the points that are not at other vehicles, from which their own distance is kept."""
        reach = self._settings.distance - self._settings.obstacle_distance  # so that no hidden point can be too near
        places = self._swarm.at(stamp, self._settings.timeout)[self._others]
        return without_vehicles(points, places, reach) if reach > 0.0 and len(places) else points

    def _of_target(self, message: PositionTarget) -> Meaning | None:
        return meaning_of_target(message, self._motion(), self._gains)

    def _of_pose(self, message: PoseStamped) -> Meaning | None:
        return meaning_of_pose(message.pose, self._motion(), self._gains)

    def _of_acceleration(self, message: Vector3Stamped) -> Meaning | None:
        return meaning_of_acceleration(message.vector, self._motion(), self._gains)

    def _motion(self) -> VehicleMotion:
        (_, pose), velocity = self._path[-1], self._swarm.velocities[self._index]
        return VehicleMotion(tuple(pose[:3].tolist()), tuple(velocity.tolist()), rotation.yaw_of(pose[3:].tolist()))

    # turns

    def step(self, stamp: rospy.Time) -> None:
        """Forward the setpoint, corrected if necessary; call it at 30 Hz."""
        now, fresh, self._fresh = stamp.to_sec(), self._fresh, False
        if fresh:
            self._came = now
        if self._setpoint is None or now - self._came > _HOLD:
            self._setpoint = None
            return
        topic, of, message = self._setpoint
        meaning = None if self._vehicle.is_on_ground or not self._path else of(message)
        self._unchecked += fresh and meaning is None and not self._vehicle.is_on_ground
        before = self._verdict is not None and self._verdict.corrected
        self._verdict = verdict = None if meaning is None else self._check(meaning, now)
        if meaning is None or verdict is None or not verdict.corrected:
            if fresh or before:
                self._outputs[topic].publish(message)
            if before:
                self._publish_intervention(stamp, meaning, verdict)
            return
        self._corrections += 1
        fill_target(self._target, verdict.velocity.tolist(), meaning)
        self._target.header.stamp = stamp
        self._outputs[_TARGET].publish(self._target)
        self._publish_intervention(stamp, meaning, verdict)

    def _check(self, meaning: Meaning, now: float) -> Verdict:
        places, trajectories = self._swarm.at(now, self._settings.timeout), self._trajectories
        on_trajectory = trajectories.commands(self._index, meaning.position)
        agreed = [on_trajectory and trajectories.agreed(self._index, other) for other in self._others]
        return self._filter.check(
            np.array(meaning.velocity),
            self._path[-1][1][:3].copy(),
            places[self._others],
            self._swarm.velocities[self._others],
            self._points,
            np.array(agreed, dtype=np.bool_),
            is_clear=on_trajectory and self._is_clear(now),
        )

    def _is_clear(self, now: float) -> bool:
        """Return whether the vehicle touches no point on the trajectory that it flies, as far off it as it is."""
        flown = self._trajectories.flown(self._index)
        return flown is not None and self._clearance.least(flown.spline, self._points, now) >= flown.radius + flown.off

    def _publish_intervention(self, stamp: rospy.Time, meaning: Meaning | None, verdict: Verdict | None) -> None:
        report = self._intervention
        report.header.stamp = stamp
        report.corrected = verdict is not None and verdict.corrected
        report.wanted = Vector3(*(meaning.velocity if meaning else (0.0, 0.0, 0.0)))
        report.commanded = Vector3(*(verdict.velocity.tolist() if verdict else (0.0, 0.0, 0.0)))
        report.cause = self._cause(verdict)
        report.nearest, report.excess = (verdict.nearest, verdict.excess) if verdict else (np.inf, 0.0)
        self._report.publish(report)

    def _cause(self, verdict: Verdict | None) -> str:
        if verdict is None or not verdict.corrected:
            return ""
        return self._names[self._others[verdict.cause]] if verdict.cause >= 0 else "obstacle"

    def status(self, now: float) -> DiagnosticStatus:
        """Return the state of this vehicle's filter for /diagnostics."""
        level, summary = self._summary(now)
        nearest = self._verdict.nearest if self._verdict else np.inf
        values = (
            ("Corrected setpoints", str(self._corrections)),
            ("Unchecked setpoints", str(self._unchecked)),
            ("Nearest (m)", f"{nearest:.2f}"),
            ("Obstacle points", str(len(self._points))),
        )
        return DiagnosticStatus(
            level, f"{self.name}: safety filter", summary, self.name, [KeyValue(key, value) for key, value in values]
        )

    def _summary(self, now: float) -> tuple[int, str]:
        timeout, verdict = self._settings.timeout, self._verdict
        if not self._path or now - self._path[-1][0] > timeout:
            return DiagnosticStatus.ERROR, "no position of this vehicle: setpoints are not checked"
        if self._setpoint is None:
            return DiagnosticStatus.OK, "no setpoints"
        if verdict is not None and verdict.excess > 0.0:
            return DiagnosticStatus.ERROR, f"too close to {self._cause(verdict)}, {verdict.nearest:.1f} m"
        old = [self._names[i] for i in self._swarm.old(now, timeout) if i != self._index]
        if old:
            return DiagnosticStatus.WARN, f"no recent position of {', '.join(old)}"
        if self._settings.cloud and now - self._points_time > timeout:
            return DiagnosticStatus.WARN, f"no recent cloud on {self._settings.cloud}"
        if verdict is not None and verdict.corrected:
            return (
                DiagnosticStatus.WARN,
                f"setpoint corrected because of {self._cause(verdict)}, {verdict.nearest:.1f} m",
            )
        return DiagnosticStatus.OK, "on the ground" if self._vehicle.is_on_ground else "setpoints pass unchanged"


class SafetyNode:
    """Filters of the vehicles served by this process."""

    def __init__(self, fleet: Sequence[str], served: Sequence[str], settings: SafetySettings, swarm_topic: str) -> None:
        """Declare the topics.

        Args:
            fleet: names of all vehicles.
            served: names of the vehicles whose setpoints are filtered here.
            settings: Settings of the filters.
            swarm_topic: topic with the states of all vehicles; empty: each vehicle's own topics.
        """
        self._fleet, self._topic = fleet, swarm_topic
        self._swarm = SwarmPositions(len(fleet))
        self._trajectories = FlownTrajectories(len(fleet), settings.distance, settings.tracking)
        self._timeout = settings.timeout
        self._vehicles = [
            GuardedVehicle(fleet, fleet.index(name), self._swarm, self._trajectories, settings) for name in served
        ]
        self._diagnostics = lockstep.Publisher("/diagnostics", DiagnosticArray)
        self._reported = -np.inf
        if swarm_topic:
            lockstep.Subscriber(swarm_topic, Float64MultiArray, self._on_swarm)
        else:
            for i, name in enumerate(fleet):
                base = f"/{name}/mavros/local_position"
                lockstep.Subscriber(f"{base}/pose", PoseStamped, partial(self._on_position, i))
                lockstep.Subscriber(f"{base}/velocity_local", TwistStamped, partial(self._on_velocity, i))
        if settings.tracking > 0.0:
            for i, name in enumerate(fleet):
                topic = f"/{name}/planner/trajectory"
                lockstep.Subscriber(topic, SplineTrajectory, partial(self._on_trajectory, i))
        lockstep.add_reset_hook(self._restart)

    def step(self) -> None:
        """Forward the setpoints of all vehicles; call it at 30 Hz."""
        stamp = rospy.Time.now()
        self._trajectories.update(self._swarm.at(stamp.to_sec(), self._timeout), stamp.to_sec())
        for vehicle in self._vehicles:
            vehicle.step(stamp)
        if stamp.to_sec() - self._reported >= _REPORT_PERIOD:
            self._reported = stamp.to_sec()
            message = DiagnosticArray(status=[vehicle.status(self._reported) for vehicle in self._vehicles])
            message.header.stamp = stamp
            self._diagnostics.publish(message)

    def _restart(self) -> None:
        self._swarm.restart()
        self._trajectories.restart()
        self._reported = -np.inf
        for vehicle in self._vehicles:
            vehicle.restart()

    def _on_swarm(self, message: Float64MultiArray) -> None:
        try:
            self._swarm.on_all(message.data, rospy.Time.now().to_sec())
        except ValueError as error:
            rospy.logwarn_throttle_identical(10.0, f"{self._topic}: {error}; ignored")

    def _on_position(self, index: int, message: PoseStamped) -> None:
        p = message.pose.position
        self._swarm.on_position(index, (p.x, p.y, p.z), rospy.Time.now().to_sec())

    def _on_trajectory(self, index: int, message: SplineTrajectory) -> None:
        try:
            spline = spline_of(message, rospy.get_time())
            self._trajectories.on_trajectory(index, message.id, spline, message.radius)
        except TrajectoryError as error:
            rospy.logwarn_throttle_identical(5.0, f"trajectory of {self._fleet[index]}: {error}; ignored")

    def _on_velocity(self, index: int, message: TwistStamped) -> None:
        v = message.twist.linear
        self._swarm.on_velocity(index, (v.x, v.y, v.z))


def served_names(arguments: Sequence[str], fleet: Sequence[str]) -> list[str]:
    """Return the vehicles named on the command line, or the whole fleet if there are none.

    Raises:
        ArgumentError: a vehicle is not in the fleet.
    """
    for name in arguments:
        if name not in fleet:
            allowed = f"{fleet[0]} to {fleet[-1]}" if len(fleet) > 1 else fleet[0]
            raise ArgumentError(f"vehicle: {name!r} is not allowed, {allowed} (/xtdrone/fleet)")
    return list(dict.fromkeys(arguments)) or list(fleet)


def run_safety_filter() -> int:
    """Run the program with ``sys.argv``; return the exit status."""

    def main(arguments: Sequence[str]) -> None:
        fleet = [vehicle.name for vehicle in needed_fleet(rospy.get_param("/xtdrone/fleet", None))]
        served = served_names(arguments, fleet)
        name = "safety_filter" if len(served) == len(fleet) else f"{served[0]}_safety_filter"
        lockstep.init_node(name, rate=RATE)
        try:
            settings = SafetySettings.from_parameters(rospy.get_param)
        except ValueError as error:
            raise ArgumentError(str(error)) from error
        swarm_topic = str(rospy.get_param("~swarm_topic", rospy.get_param("/xtdrone/swarm_topic", "")))
        with lockstep.registering_together():
            node = SafetyNode(fleet, served, settings, swarm_topic)
        run_node(node)

    return run_program(main, sys.argv, USAGE)
