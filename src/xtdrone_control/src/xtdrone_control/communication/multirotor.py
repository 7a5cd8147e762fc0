"""Communication node of multirotors: from XTDrone's command topics to MAVROS's setpoints and services.

For each vehicle ``T`` (such as ``iris_0``):

=====================================  ==========================  ==================================================
topic                                  type                        meaning
=====================================  ==========================  ==================================================
/xtdrone/T/cmd                         std_msgs/String             ARM, DISARM, HOVER, or a mode's name
/xtdrone/T/cmd_pose_enu, cmd_pose_flu  geometry_msgs/Pose          pose in the local frame, or offset from the vehicle
/xtdrone/T/cmd_vel_enu, cmd_vel_flu    geometry_msgs/Twist         velocity, yaw rate in angular.z
/xtdrone/T/cmd_accel_enu, .._flu       geometry_msgs/Twist         acceleration, yaw rate in angular.z
/T/mavros/local_position/pose          geometry_msgs/PoseStamped   for HOVER and the hold before any input
/T/mavros/state                        mavros_msgs/State           confirmation of commands
/T/mavros/setpoint_raw/local           mavros_msgs/PositionTarget  out, 30 Hz
=====================================  ==========================  ==================================================
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from queue import SimpleQueue

import rospy
from geometry_msgs.msg import Pose, PoseStamped, Twist
from mavros_msgs.msg import PositionTarget, State
from mavros_msgs.srv import CommandBool, SetMode
from std_msgs.msg import String

import xtdrone_lockstep as lockstep
from xtdrone_control.communication.commands import HOVER_SPEED, CommandRequest, MultirotorCore, Steady
from xtdrone_control.communication.setpoint import Setpoint, Vector
from xtdrone_lockstep.ros_codec import compile_class

RATE = 30  # Hz
_ANSWER_LIMIT = 100.0  # s of wall time; a MAVROS layer that hangs is dropped by the simulator earlier than this


class RosLog:
    """Log messages of the core on rosout."""

    def info(self, text: str) -> None:
        """Log at INFO."""
        rospy.loginfo(text)

    def warning(self, text: str) -> None:
        """Log at WARN."""
        rospy.logwarn(text)

    def stream_warning(self, text: str) -> None:
        """Log at WARN, identical texts once in 5 s."""
        rospy.logwarn_throttle_identical(5.0, text)


class MavrosServices:
    """Calls the MAVROS services of one vehicle.

    In lockstep a call blocks: the simulator waits, so the result arrives in the same tick in every run. In real time a
    slow reply would interrupt the setpoint stream and end OFFBOARD, so the call runs in the background. In both cases a
    separate thread makes the call, since rospy waits for a reply without a timeout. During a blocking call the
    simulator is asked to advance time: PX4 replies only then, and a MAVROS outside the lockstep cannot request it.
    """

    def __init__(self, vehicle: str, *, in_lockstep: bool) -> None:
        self._arm = rospy.ServiceProxy(f"/{vehicle}/mavros/cmd/arming", CommandBool)
        self._set_mode = rospy.ServiceProxy(f"/{vehicle}/mavros/set_mode", SetMode)
        self._calls: list[tuple[CommandRequest, Future[tuple[bool, str]]]] = []
        self._queue: SimpleQueue[tuple[Future[tuple[bool, str]], CommandRequest] | None] | None = None
        if not in_lockstep:
            self._queue = SimpleQueue()
            # One thread: calls are made in the order of the commands. A daemon also works while the program exits.
            threading.Thread(target=self._work, args=(self._queue,), name=f"{vehicle} services", daemon=True).start()

    @property
    def busy(self) -> bool:
        """Whether a call is in progress or :meth:`finished` has yet to return its result."""
        return bool(self._calls)

    def submit(self, request: CommandRequest) -> None:
        """Start a call; :meth:`finished` returns its result."""
        call: Future[tuple[bool, str]] = Future()
        if self._queue is not None:
            self._calls.append((request, call))
            self._queue.put((call, request))
            return
        thread = threading.Thread(target=self._make, args=(call, request), daemon=True)
        thread.start()
        thread.join(_ANSWER_LIMIT)
        if not call.done():
            call = Future()
            call.set_result((False, f"no response within {_ANSWER_LIMIT:g} s of wall time; is MAVROS hanging?"))
        self._calls.append((request, call))

    def finished(self) -> list[tuple[CommandRequest, bool, str]]:
        """Return (request, accepted, reason) of the calls finished since the last call, in order."""
        ended = []
        while self._calls and self._calls[0][1].done():
            request, future = self._calls.pop(0)
            ended.append((request, *future.result()))
        return ended

    def close(self) -> None:
        """Cancel the calls that have not started, and end the thread."""
        if self._queue is not None:
            for _, call in self._calls:
                call.cancel()
            self._queue.put(None)

    def _work(self, queue: SimpleQueue[tuple[Future[tuple[bool, str]], CommandRequest] | None]) -> None:
        """Make the calls of a node outside the lockstep one after another."""
        while (item := queue.get()) is not None:
            call, request = item
            if call.set_running_or_notify_cancel():
                self._make(call, request)

    def _make(self, call: Future[tuple[bool, str]], request: CommandRequest) -> None:
        try:
            with lockstep.needs_time():
                call.set_result(self._call(request))
        except Exception as error:  # for `finished` to raise
            call.set_exception(error)

    def _call(self, request: CommandRequest) -> tuple[bool, str]:
        try:
            if request.arm is None:
                return bool(self._set_mode(0, request.command).mode_sent), ""
            response = self._arm(request.arm)
        except (rospy.ROSException, rospy.ServiceException) as error:
            return False, f"{error}; is MAVROS running?"
        return bool(response.success), "" if response.success else f"MAV_RESULT {response.result}"


class MavrosLink:
    """Connects a :class:`MultirotorCore` to one vehicle's MAVROS: state and pose in, setpoints and service calls out.

    Create it between ``lockstep.init_node`` and ``lockstep.start``, then call :meth:`step` at 30 Hz.

    Attributes:
        vehicle: name, such as ``iris_0``.
        core: computes the setpoint.
    """

    def __init__(self, vehicle: str, core: MultirotorCore, *, in_lockstep: bool) -> None:
        """Declare the topics.

        Args:
            vehicle: name, such as ``iris_0``.
            core: setpoint and commands of the vehicle.
            in_lockstep: whether the node is a lockstep participant.
        """
        self.vehicle = vehicle
        self.core = core
        self._services = MavrosServices(vehicle, in_lockstep=in_lockstep)
        self._message = PositionTarget()
        self._encoded: Setpoint | None = None
        self._output = lockstep.Publisher(f"/{vehicle}/mavros/setpoint_raw/local", PositionTarget)
        lockstep.Subscriber(f"/{vehicle}/mavros/state", State, self._on_state)
        lockstep.Subscriber(f"/{vehicle}/mavros/local_position/pose", PoseStamped, self._on_pose)
        lockstep.add_reset_hook(self.core.restart)  # the vehicle is in its initial state, and time starts again

    def step(self) -> None:
        """Publish the setpoint and process the results of finished service calls; call it at 30 Hz."""
        now = rospy.Time.now()
        seconds = now.to_sec()
        for request, accepted, reason in self._services.finished():
            self._on_result(request, accepted, reason, seconds)
        setpoint = self.core.tick(seconds)
        if setpoint is not self._encoded:
            fill(self._message, setpoint)
            self._encoded = setpoint
        self._message.header.stamp = now
        self._output.publish(self._message)

    @property
    def publisher(self) -> lockstep.Publisher:
        """The publisher of the setpoint."""
        return self._output

    def steady(self) -> tuple[Steady, bytes] | None:
        """Return the state if only velocity and acceleration commands can change the setpoint, else None.

        Returns:
            The core's state, and the serialised setpoint, preceded by its length.
        """
        state = None if self._services.busy else self.core.steady()
        codec = compile_class(PositionTarget)
        if state is None or codec is None or self._encoded is not self.core.setpoint:
            return None
        packet = codec.packet(self._message, self._message.header.seq)
        return None if packet is None else (state, packet)

    def close(self) -> None:
        """Cancel pending service calls."""
        self._services.close()

    def _on_state(self, message: State) -> None:
        self.core.on_state(message.mode, message.armed)

    def _on_pose(self, message: PoseStamped) -> None:
        self.core.on_pose(*_pose(message.pose))

    def _on_result(self, request: CommandRequest, accepted: bool, reason: str, now: float) -> None:
        self.core.on_result(request, accepted, reason, now)


class MultirotorCommunication(MavrosLink):
    """XTDrone's command topics of one vehicle, carried out over its MAVROS."""

    def __init__(
        self, vehicle: str, *, hover_speed: float = HOVER_SPEED, cmd_timeout: float = 0.0, in_lockstep: bool = False
    ) -> None:
        """Declare the topics.

        Args:
            vehicle: name, such as ``iris_0``.
            hover_speed: see :class:`MultirotorCore`.
            cmd_timeout: see :class:`MultirotorCore`.
            in_lockstep: whether the node is a lockstep participant.

        Raises:
            ValueError: ``hover_speed`` or ``cmd_timeout`` is not allowed.
        """
        core = MultirotorCore(vehicle, RosLog(), hover_speed=hover_speed, cmd_timeout=cmd_timeout)
        super().__init__(vehicle, core, in_lockstep=in_lockstep)
        subscribe_commands(f"/xtdrone/{vehicle}", core, self._on_command, lambda: rospy.Time.now().to_sec())

    def _on_command(self, message: String) -> None:
        request = self.core.on_command(message.data, rospy.Time.now().to_sec())
        if request is not None:
            self._services.submit(request)

    def catch_up(self, pose: Sequence[float], command: Sequence[float]) -> None:
        """Apply the messages that compiled code received in the turns it ran, see :meth:`steady`.

        Args:
            pose: the last pose: position, m ENU, and quaternion (x, y, z, w); empty if there is none.
            command: the last velocity command outside the dead zone: m/s ENU, rad/s, and its time, s; empty if there is
                none.
        """
        if pose:
            x, y, z, *quaternion = pose
            self.core.on_pose((x, y, z), (quaternion[0], quaternion[1], quaternion[2], quaternion[3]))
        if command:
            vx, vy, vz, yaw_rate, time = command
            self.core.on_target_velocity("", (vx, vy, vz), yaw_rate, time, body=False)


def subscribe_commands(
    base: str,
    core: MultirotorCore,
    on_command: Callable[[String], None],
    seconds: Callable[[], float],
    is_active: Callable[[], bool] = lambda: True,
) -> None:
    """Subscribe to XTDrone's command topics of one vehicle.

    Args:
        base: Namespace of the topics, such as ``/xtdrone/iris_0``.
        core: Core that receives the setpoints.
        on_command: Called with the messages of ``cmd``.
        seconds: Returns the ROS time, s.
        is_active: Whether setpoints are applied now.
    """

    def on_pose(topic: str, body: bool, message: Pose) -> None:
        if is_active():
            seconds()
            core.on_target_pose(topic, *_pose(message), body=body)

    def on_twist(apply: Callable[..., None], topic: str, body: bool, message: Twist) -> None:
        if is_active():
            linear = message.linear
            apply(topic, (linear.x, linear.y, linear.z), message.angular.z, seconds(), body=body)

    lockstep.Subscriber(f"{base}/cmd", String, on_command)
    for frame, body in (("enu", False), ("flu", True)):
        for kind, message, callback in (
            ("pose", Pose, on_pose),
            ("vel", Twist, partial(on_twist, core.on_target_velocity)),
            ("accel", Twist, partial(on_twist, core.on_target_acceleration)),
        ):
            topic = f"{base}/cmd_{kind}_{frame}"
            lockstep.Subscriber(topic, message, partial(callback, topic, body))


def fill(message: PositionTarget, setpoint: Setpoint) -> None:
    """Write a setpoint to a message, except the header."""
    message.coordinate_frame = setpoint.frame
    message.type_mask = setpoint.type_mask
    for target, (x, y, z) in (
        (message.position, setpoint.position),
        (message.velocity, setpoint.velocity),
        (message.acceleration_or_force, setpoint.acceleration),
    ):
        target.x, target.y, target.z = x, y, z
    message.yaw = setpoint.yaw
    message.yaw_rate = setpoint.yaw_rate


def _pose(pose: Pose) -> tuple[Vector, tuple[float, float, float, float]]:
    """Return position and quaternion (x, y, z, w)."""
    p, q = pose.position, pose.orientation
    return (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)
