"""The simplified vehicles on the topics and services of MAVROS and XTDrone, in place of autopilots behind MAVLink.

For each vehicle T (such as iris_0), as in the MAVROS layer of the full stack:

========================================  ==========================  ================================================
published while subscribed
/T/mavros/local_position/pose             PoseStamped                 30 Hz, frame map
/T/mavros/local_position/velocity_local   TwistStamped                30 Hz, ENU, frame base_link as MAVROS names it
/T/mavros/state                           mavros_msgs/State           1 Hz, and on every change
/T/mavros/extended_state                  mavros_msgs/ExtendedState   5 Hz
/xtdrone/swarm                            Float64MultiArray           30 Hz, see mavros.swarm_state_topic
subscribed
/T/mavros/setpoint_raw/local              PositionTarget              see setpoints.py
/xtdrone/T/cmd, cmd_vel_enu, ...          see xtdrone_control.communication.multirotor
services
/T/mavros/cmd/arming, set_mode            CommandBool, SetMode
/T/mavros/cmd/takeoff, cmd/land           CommandTOL                  AUTO.TAKEOFF, AUTO.LAND; the position is ignored
========================================  ==========================  ================================================

XTDrone's commands are executed until the first setpoint arrives on ``setpoint_raw/local`` for that vehicle, which shows
that it has a communication node. When such setpoints stop, the vehicle changes from OFFBOARD to POSCTL and holds
position, as in PX4 (COM_OF_LOSS_T, COM_OBL_RC_ACT). Messages sent in a tick act from the time of that tick.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any, Protocol

import rospy
from geometry_msgs.msg import PoseStamped, TwistStamped
from mavros_msgs.msg import ExtendedState, PositionTarget, State
from mavros_msgs.srv import CommandBool, CommandBoolResponse, CommandTOL, CommandTOLResponse, SetMode, SetModeResponse
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, String

import xtdrone_lockstep as lockstep
from xtdrone_autopilot.commander.offboard_setpoint import CommandStart
from xtdrone_common import modes
from xtdrone_common.modes import ModeError, mode_name, mode_number
from xtdrone_control.communication.commands import MultirotorCore
from xtdrone_control.communication.multirotor import RosLog, subscribe_commands
from xtdrone_control.communication.setpoint import FRAME_LOCAL_NED, Setpoint, Vector
from xtdrone_mavros.swarm_state_topic import FIELDS, TOPIC
from xtdrone_sim.mailbox import ClosedError, Mailbox
from xtdrone_swarm.simplified.setpoints import SetpointError, Start, wanted
from xtdrone_swarm.swarm_vehicles import HOLD, Vehicles

_ACCEPTED, _TEMPORARILY_REJECTED = 0, 1  # MAV_RESULT
_STANDBY, _ACTIVE = 3, 4  # MAV_STATE
_CUSTOM_MODE_ENABLED, _GUIDED, _MANUAL_INPUT = 1, 8, 64  # MAV_MODE_FLAG
_FLAGS = {mode.name: mode.flags for mode in modes.SUPPORTED}
_WARNING_PERIOD = 5.0  # wall s between two equal warnings
_PAUSE = 1.0  # s without setpoints after which a new stream begins, PX4's COM_OF_LOSS_T

_ON_GROUND, _IN_AIR, _TAKEOFF, _LANDING = 1, 2, 3, 4  # MAV_LANDED_STATE


class SteeredVehicles(Vehicles, Protocol):
    """Vehicles with setpoints that may include a heading."""

    def steer_one(
        self,
        index: int,
        kind: int,
        vector: tuple[float, float, float],
        yaw_rate: float = 0.0,
        *,
        yaw: float = math.nan,
    ) -> None:
        """Set one vehicle's setpoint, ENU, with a yaw rate, rad/s, or a heading, rad, if given."""

    def reset(self, index: int, place: Sequence[float] | None = None, heading: float | None = None) -> None:
        """Put one vehicle back, where it started or at ``place`` (x, y, z), m ENU, with a heading, rad."""


class VehicleTopics:
    """Topics and services of one vehicle."""

    def __init__(
        self,
        vehicles: SteeredVehicles,
        index: int,
        mailbox: Mailbox,
        seconds: Callable[[], float],
        *,
        hover_speed: float,
        cmd_timeout: float,
        setpoint_timeout: float,
    ) -> None:
        """Advertise and subscribe to the topics of a vehicle.

        Args:
            vehicles: all vehicles.
            index: number of this vehicle.
            mailbox: passes service calls to the simulator's thread.
            seconds: returns the simulated time, s.
            hover_speed: see ``MultirotorCore``.
            cmd_timeout: see ``MultirotorCore``.
            setpoint_timeout: time without a setpoint after which OFFBOARD ends, s; 0: never.

        Raises:
            ValueError: ``hover_speed`` or ``cmd_timeout`` is not allowed.
        """
        self._vehicles = vehicles
        self._index = index
        self._mailbox = mailbox
        self._seconds = seconds
        self._setpoint_timeout = setpoint_timeout
        self.name = name = vehicles.names[index]
        self._core = MultirotorCore(name, RosLog(), hover_speed=hover_speed, cmd_timeout=cmd_timeout)
        base = f"/{name}/mavros"
        self._frame_was_unset = False
        self._pose_publisher = lockstep.Publisher(f"{base}/local_position/pose", PoseStamped)
        self._velocity_publisher = lockstep.Publisher(f"{base}/local_position/velocity_local", TwistStamped)
        self._state_publisher = lockstep.Publisher(f"{base}/state", State)
        self._extended_publisher = lockstep.Publisher(f"{base}/extended_state", ExtendedState)
        self._pose = PoseStamped()
        self._pose.header.frame_id = "map"
        self._velocity = TwistStamped()
        self._velocity.header.frame_id = "base_link"
        # Subscribed first, so that the source of control is known before a command of the same tick.
        lockstep.Subscriber(f"{base}/setpoint_raw/local", PositionTarget, self._on_target)
        subscribe_commands(f"/xtdrone/{name}", self._core, self._on_command, self._look, lambda: self._commanded)
        for service, kind, handler in (
            ("cmd/arming", CommandBool, self._arm),
            ("set_mode", SetMode, self._set_mode),
            ("cmd/takeoff", CommandTOL, partial(self._take_off_or_land, "AUTO.TAKEOFF")),
            ("cmd/land", CommandTOL, partial(self._take_off_or_land, "AUTO.LAND")),
        ):
            rospy.Service(f"{base}/{service}", kind, handler)
        self.restart()

    def restart(self) -> None:
        """Reset all inputs and the record of published states, as at the start."""
        self._core.restart()
        self._commanded = True  # by XTDrone's commands, not by setpoints
        self._target_at = -math.inf  # s, arrival of the last setpoint
        self._steered_at = -math.inf  # s, of the last setpoint or XTDrone command that was flown
        self._command_start: CommandStart[Start] = CommandStart()
        self._flown: Setpoint | None = None  # the setpoint last received from the core
        self._said: tuple[str, bool] | None = None
        self._looked = -1.0  # s, of simulated time

    # publications

    @property
    def _here(self) -> Vector:
        x, y, z = self._vehicles.position[self._index].tolist()
        return x, y, z

    @property
    def _heading(self) -> float:
        return float(self._vehicles.yaw[self._index])

    def publish_motion(self, now: rospy.Time) -> None:
        """Publish pose and velocity."""
        if self._pose_publisher.get_num_connections():
            pose = self._pose.pose
            self._pose.header.stamp = now
            pose.position.x, pose.position.y, pose.position.z = self._here
            half = 0.5 * self._heading
            pose.orientation.z, pose.orientation.w = math.sin(half), math.cos(half)
            self._pose_publisher.publish(self._pose)
        if self._velocity_publisher.get_num_connections():
            linear = self._velocity.twist.linear
            self._velocity.header.stamp = now
            linear.x, linear.y, linear.z = self._vehicles.velocity[self._index].tolist()
            self._velocity_publisher.publish(self._velocity)

    def publish_state(self, now: rospy.Time, due: bool) -> None:
        """Publish mode and arming state, if due or changed."""
        mode, armed = self._vehicles.mode[self._index], bool(self._vehicles.armed[self._index])
        changed = self._said != (mode, armed)
        self._said = (mode, armed)
        if not (due or changed) or not self._state_publisher.get_num_connections():
            return
        flags = _FLAGS.get(mode, 0)
        message = State(connected=True, armed=armed, mode=mode)
        message.guided, message.manual_input = bool(flags & _GUIDED), bool(flags & _MANUAL_INPUT)
        message.system_status = _ACTIVE if armed else _STANDBY
        message.header.stamp = now
        self._state_publisher.publish(message)

    def publish_extended(self, now: rospy.Time) -> None:
        """Publish the landed state."""
        if not self._extended_publisher.get_num_connections():
            return
        message = ExtendedState(landed_state=self._landed_state())
        message.header.stamp = now
        self._extended_publisher.publish(message)

    def _landed_state(self) -> int:
        index, mode = self._index, self._vehicles.mode[self._index]
        if not self._vehicles.armed[index] or self._vehicles.position[index, 2] <= 0.0:
            return _ON_GROUND
        return {"AUTO.TAKEOFF": _TAKEOFF, "AUTO.LAND": _LANDING}.get(mode, _IN_AIR)

    # setpoints

    def _on_target(self, target: PositionTarget) -> None:
        if self._commanded:
            self._commanded = False
            rospy.logdebug("simulator: %s now follows the setpoints of MAVROS", self.name)
        self._target_at = self._seconds()
        p, v, a = target.position, target.velocity, target.acceleration_or_force
        setpoint = Setpoint(
            target.coordinate_frame or self._unset_frame(),
            target.type_mask,
            (p.x, p.y, p.z),
            (v.x, v.y, v.z),
            (a.x, a.y, a.z),
            target.yaw,
            target.yaw_rate,
        )
        self._fly(setpoint)

    def _unset_frame(self) -> int:
        """Return the frame of a setpoint without one, as the MAVROS layer does, with a warning the first time."""
        if not self._frame_was_unset:
            self._frame_was_unset = True
            text = "simulator: /%s/mavros/setpoint_raw/local: coordinate_frame is 0, unset; it counts as 1 (LOCAL_NED)"
            rospy.logwarn(text, self.name)
        return FRAME_LOCAL_NED

    def _fly(self, setpoint: Setpoint) -> None:
        try:
            kind, vector, yaw_rate, yaw = wanted(setpoint, self._start_of(setpoint), self._heading)
        except SetpointError as error:
            text = f"simulator: /{self.name}/mavros/setpoint_raw/local: {error}; the setpoint is ignored"
            rospy.logwarn_throttle_identical(_WARNING_PERIOD, text)
            return
        self._vehicles.steer_one(self._index, kind, vector, yaw_rate, yaw=yaw)

    def _start_of(self, setpoint: Setpoint) -> Start:
        """Return where the vehicle was when the command of this setpoint came; see ``CommandStart``."""
        now, before = self._seconds(), self._steered_at
        self._steered_at = now
        repeated = self._vehicles.mode[self._index] == "OFFBOARD" and 0.0 <= now - before <= _PAUSE
        values = (setpoint.frame, setpoint.type_mask, *setpoint.position, *setpoint.velocity, *setpoint.acceleration)
        here = Start(self._here, self._heading)
        return self._command_start.update((*values, setpoint.yaw, setpoint.yaw_rate), here, repeated=repeated)

    def _miss_targets(self) -> None:
        """Leave OFFBOARD when the setpoints have stopped, so that the last one does not act indefinitely."""
        silence = self._seconds() - self._target_at
        if not 0.0 < self._setpoint_timeout < silence or self._vehicles.mode[self._index] != "OFFBOARD":
            return
        rospy.logwarn("simulator: %s: no setpoint for %g s: POSCTL", self.name, self._setpoint_timeout)
        self._vehicles.command(self._index, "POSCTL")

    # XTDrone's commands

    def _look(self) -> float:
        """Update the core with the vehicle's state, once per tick; return the simulated time, s."""
        now = self._seconds()
        if now != self._looked:
            self._looked = now
            half = 0.5 * self._heading
            self._core.on_state(self._vehicles.mode[self._index], bool(self._vehicles.armed[self._index]))
            self._core.on_pose(self._here, (0.0, 0.0, math.sin(half), math.cos(half)))
        return now

    def act(self) -> None:
        """Execute XTDrone's commands or supervise the setpoints; called at 30 Hz, after the messages of a tick."""
        if not self._commanded:
            self._miss_targets()
            return
        setpoint = self._core.tick(self._look())
        if setpoint is self._flown and setpoint.frame == FRAME_LOCAL_NED:
            return
        if self._core.holding:
            if setpoint is not self._flown:
                self._vehicles.steer_one(self._index, HOLD, self._here)
        else:
            self._fly(setpoint)
        self._flown = setpoint

    def _on_command(self, message: String) -> None:
        if not self._commanded:
            return
        now = self._look()
        request = self._core.on_command(message.data, now)
        if request is None:
            return
        refusal = self._vehicles.command(self._index, request.command)
        self._core.on_result(request, not refusal, refusal, now)
        self._core.on_state(self._vehicles.mode[self._index], bool(self._vehicles.armed[self._index]))

    # services; their handlers run in rospy's threads

    def _ask(self, text: str) -> str:
        """Send the vehicle a command in the simulator's thread; return the reason for a rejection, or "".

        Raises:
            ServiceException: the simulator is shutting down.
        """

        def act(answer: Future[Any]) -> None:
            answer.set_result(self._vehicles.command(self._index, text))

        try:
            return str(self._mailbox.put(act).result())
        except ClosedError as error:
            raise rospy.ServiceException(str(error)) from error

    def _arm(self, request: Any) -> CommandBoolResponse:
        return CommandBoolResponse(*self._outcome("ARM" if request.value else "DISARM"))

    def _take_off_or_land(self, mode: str, _request: Any) -> CommandTOLResponse:
        return CommandTOLResponse(*self._outcome(mode))

    def _outcome(self, text: str) -> tuple[bool, int]:
        refusal = self._ask(text)
        if refusal:
            rospy.logwarn("simulator: %s", refusal)
        return not refusal, _TEMPORARILY_REJECTED if refusal else _ACCEPTED

    def _set_mode(self, request: Any) -> SetModeResponse:
        """Set a mode; as in MAVROS, ``mode_sent`` means that the mode exists, not that it was accepted."""
        try:
            mode = mode_name(_CUSTOM_MODE_ENABLED, mode_number(request.custom_mode))
        except ModeError as error:
            rospy.logerr("simulator: %s: set_mode: %s", self.name, error)
            return SetModeResponse(mode_sent=False)
        self._outcome(mode)
        return SetModeResponse(mode_sent=True)


class SwarmTopic:
    """Positions and velocities of all vehicles in one message."""

    def __init__(self, vehicles: Vehicles) -> None:
        """Advertise the topic."""
        count = len(vehicles.names)
        self._vehicles = vehicles
        self._publisher = lockstep.Publisher(TOPIC, Float64MultiArray)
        self._message = Float64MultiArray()
        self._message.layout.dim = [
            MultiArrayDimension("vehicle", count, count * FIELDS),
            MultiArrayDimension("x y z vx vy vz, ENU", FIELDS, FIELDS),
        ]

    def publish(self) -> None:
        """Publish if the topic has a subscriber."""
        if not self._publisher.get_num_connections():
            return
        data: list[float] = []
        rows = zip(self._vehicles.position.tolist(), self._vehicles.velocity.tolist(), strict=True)
        for position, velocity in rows:
            data += position
            data += velocity
        self._message.data = data
        self._publisher.publish(self._message)
