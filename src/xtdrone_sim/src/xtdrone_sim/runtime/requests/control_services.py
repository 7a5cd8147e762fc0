"""Control of the simulation on the ROS graph: XTDrone's services and topics, and those of Gazebo.

=====================================  =================================  ============================================
/simulator/set_speed                   xtdrone_msgs/SetSpeed              target real-time factor
/simulator/pause, resume               std_srvs/Trigger
/simulator/step                        xtdrone_msgs/Step                  a number of ticks, or to a simulated time
/simulator/hold                        xtdrone_msgs/Hold                  between two ticks, as long as its connection
/simulator/get_status                  xtdrone_msgs/GetStatus
/simulator/status (topic)              xtdrone_msgs/SimulationStatus      latched; on change, at least every wall second
/simulator/speed (topic, in)           std_msgs/Float64                   target real-time factor
/gazebo/pause_physics, unpause_...     std_srvs/Empty
/gazebo/reset_world                    std_srvs/Empty                     initial state; simulated time continues
/gazebo/reset_simulation               std_srvs/Empty                     the same, from simulated time 0
/gazebo/get_physics_properties         gazebo_msgs/GetPhysicsProperties
/gazebo/set_physics_properties         gazebo_msgs/SetPhysicsProperties   max_update_rate is 250 x speed
/gazebo/get_world_properties           gazebo_msgs/GetWorldProperties
=====================================  =================================  ============================================

rospy calls the handlers in its own threads; they pass each request to the simulator's thread and wait for the answer.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any

import rospy
from gazebo_msgs.msg import ODEPhysics
from gazebo_msgs.srv import (
    GetPhysicsProperties,
    GetPhysicsPropertiesResponse,
    GetWorldProperties,
    GetWorldPropertiesResponse,
    SetPhysicsProperties,
    SetPhysicsPropertiesResponse,
)
from geometry_msgs.msg import Vector3
from std_msgs.msg import Float64
from std_srvs.srv import Empty, EmptyResponse, Trigger, TriggerResponse
from xtdrone_msgs.msg import SimulationStatus
from xtdrone_msgs.srv import (
    GetStatus,
    GetStatusResponse,
    Hold,
    HoldResponse,
    SetSpeed,
    SetSpeedResponse,
    Step,
    StepResponse,
)

from xtdrone_common.programs.node_command_line import LEAST_SPEED
from xtdrone_sim.mailbox import ClosedError, Mailbox
from xtdrone_sim.runtime.requests.simulation_control import Control, ControlError, Reset, Status, StepRequest
from xtdrone_sim.runtime.requests.standstills import Holder

_STATUS_PERIOD = 1.0  # wall s
_STATE_PERIOD = 0.1  # wall s between two polls of changes that arrive without an event


class Services:
    """Services and topics around a :class:`Control`.

    All methods except the handlers are called in the simulator's thread.
    """

    def __init__(
        self,
        control: Control,
        mailbox: Mailbox,
        *,
        step_s: float,
        gravity: float,
        model_names: Callable[[], Sequence[str]],
    ) -> None:
        """Advertise the services and topics.

        Args:
            control: control of the simulation.
            mailbox: passes requests to the simulator's thread.
            step_s: physics step, s.
            gravity: gravity of the world, m/s^2.
            model_names: returns the names of the models in the world; called in the simulator's thread.
        """
        self._control = control
        self._mailbox = mailbox
        self._step_s = step_s
        self._gravity = gravity
        self._model_names = model_names
        self._next_status = 0.0
        self._next_look = 0.0
        self._status = rospy.Publisher("~status", SimulationStatus, latch=True, queue_size=10)
        rospy.Subscriber("~speed", Float64, self._on_speed)
        for name, kind, handler in (
            ("~set_speed", SetSpeed, self._set_speed),
            ("~pause", Trigger, partial(self._trigger, control.pause)),
            ("~resume", Trigger, partial(self._trigger, control.resume)),
            ("~step", Step, self._step),
            ("~hold", Hold, self._hold),
            ("~get_status", GetStatus, self._get_status),
            ("/gazebo/pause_physics", Empty, partial(self._empty, control.pause)),
            ("/gazebo/unpause_physics", Empty, partial(self._empty, control.resume)),
            ("/gazebo/reset_world", Empty, partial(self._reset, Reset.WORLD)),
            ("/gazebo/reset_simulation", Empty, partial(self._reset, Reset.SIMULATION)),
            ("/gazebo/get_physics_properties", GetPhysicsProperties, self._get_physics),
            ("/gazebo/set_physics_properties", SetPhysicsProperties, self._set_physics),
            ("/gazebo/get_world_properties", GetWorldProperties, self._get_world),
        ):
            rospy.Service(name, kind, handler)

    def tend(self) -> None:
        """Publish the status when it is due; called at every turn of the main loop."""
        now = time.monotonic()
        if now >= self._next_look:
            self._next_look = now + _STATE_PERIOD
            self._control.tend()
        if self._control.changed or now >= self._next_status:
            self._control.changed = False
            self._next_status = now + _STATUS_PERIOD
            self._status.publish(status_message(self._control.status()))

    # handlers, called in rospy's threads

    def _ask(self, request: Callable[[Future[Any]], None]) -> Any:
        """Return the answer of the simulator's thread.

        Raises:
            ServiceException: the request was not carried out.
        """
        try:
            return self._mailbox.put(request).result()
        except (ClosedError, ControlError) as error:
            raise rospy.ServiceException(str(error)) from error

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call ``function`` in the simulator's thread and return its result."""
        return self._ask(lambda answer: answer.set_result(function(*arguments)))

    def _trigger(self, function: Callable[[str], str], request: Any) -> TriggerResponse:
        return TriggerResponse(True, self._call(function, _caller(request)))

    def _empty(self, function: Callable[[str], str], request: Any) -> EmptyResponse:
        self._call(function, _caller(request))
        return EmptyResponse()

    def _set_speed(self, request: Any) -> SetSpeedResponse:
        try:
            return SetSpeedResponse(True, self._call(self._control.set_speed, request.speed, _caller(request)))
        except ValueError as error:
            return SetSpeedResponse(False, str(error))

    def _on_speed(self, message: Float64) -> None:
        """Set the speed received on ``~speed``, without waiting for the result."""
        sender = message._connection_header["callerid"]

        def act(answer: Future[Any]) -> None:
            answer.set_result(None)
            try:
                self._control.set_speed(message.data, sender)
            except ValueError as error:
                rospy.logwarn("simulator: %s: %s, from %s", rospy.resolve_name("~speed"), error, sender)

        self._mailbox.put(act)

    def _step(self, request: Any) -> StepResponse:
        wanted = StepRequest(request.ticks, _microseconds(request.until), _microseconds(request.duration))
        answer = self._ask(lambda answer: self._control.ask_step(wanted, _caller(request), answer))
        return StepResponse(answer.success, answer.message, _time(answer.time_us), answer.ticks)

    def _hold(self, request: Any) -> HoldResponse:
        # rospy serves each connection in a thread of its own, which ends when the connection closes.
        holder = Holder(_caller(request), threading.current_thread())
        if request.hold:
            answer = self._ask(lambda answer: self._control.ask_hold(holder, answer))
            return HoldResponse(answer.success, answer.message, answer.tick, _time(answer.time_us))
        done = self._call(self._control.let_go, holder)
        status = self._call(self._control.status)
        return HoldResponse(True, done, status.tick, _time(status.time_us))

    def _reset(self, kind: Reset, request: Any) -> EmptyResponse:
        self._ask(lambda answer: self._control.ask_reset(kind, _caller(request), answer))
        return EmptyResponse()

    def _get_status(self, _request: Any) -> GetStatusResponse:
        return GetStatusResponse(status_message(self._call(self._control.status)))

    # Gazebo's properties

    def _get_physics(self, _request: Any) -> GetPhysicsPropertiesResponse:
        status = self._call(self._control.status)
        return GetPhysicsPropertiesResponse(
            time_step=self._step_s,
            pause=status.paused,
            max_update_rate=status.speed / self._step_s,
            gravity=Vector3(0.0, 0.0, -self._gravity),
            ode_config=ODEPhysics(),
            success=True,
            status_message="the physics engine is Bullet: ode_config has no meaning",
        )

    def _set_physics(self, request: Any) -> SetPhysicsPropertiesResponse:
        obstacle = self._physics_obstacle(request)
        if obstacle:
            return SetPhysicsPropertiesResponse(False, obstacle)
        speed = target_speed(request.max_update_rate, self._step_s)
        done = self._call(self._control.set_speed, speed, _caller(request))
        ignored = "" if request.ode_config == ODEPhysics() else "; ode_config ignored, the physics engine is Bullet"
        return SetPhysicsPropertiesResponse(True, done + ignored)

    def _physics_obstacle(self, request: Any) -> str:
        """Return a text on the value of ``request`` that is not allowed; "" if all are allowed."""
        if not math.isclose(request.time_step, self._step_s, rel_tol=1e-6):
            return f"time_step: {request.time_step:g} s is not allowed, it is always {self._step_s:g} s"
        try:
            target_speed(request.max_update_rate, self._step_s)
        except ValueError as error:
            return str(error)
        g = request.gravity
        if math.dist((g.x, g.y, g.z), (0.0, 0.0, -self._gravity)) > 1e-6:
            return (
                f"gravity: ({g.x:g}, {g.y:g}, {g.z:g}) m/s^2 is not allowed, it is (0, 0, {-self._gravity:g}) in this "
                "world; another one needs a world file of its own"
            )
        return ""

    def _get_world(self, _request: Any) -> GetWorldPropertiesResponse:
        return GetWorldPropertiesResponse(
            sim_time=self._call(self._control.status).time_us * 1e-6,
            model_names=self._call(self._model_names),
            rendering_enabled=False,
            success=True,
            status_message="",
        )


def target_speed(rate: float, step_s: float) -> float:
    """Return the target real-time factor for Gazebo's ``max_update_rate``.

    Args:
        rate: steps per wall second, Hz; 0 for unlimited.
        step_s: physics step, s.

    Raises:
        ValueError: the rate is not allowed.
    """
    least = LEAST_SPEED / step_s
    # Both values are rounded: the minimum rate given in the error text must be accepted and yield the minimum speed.
    if not math.isfinite(rate) or (rate != 0.0 and rate < least * (1.0 - 1e-9)):
        raise ValueError(f"max_update_rate: {rate:g} Hz is not allowed, 0 (unlimited) or at least {least:g} Hz")
    return max(rate * step_s, LEAST_SPEED) if rate else 0.0


def status_message(status: Status) -> SimulationStatus:
    """Return the status as a ROS message."""
    return SimulationStatus(
        sim_time=_time(status.time_us),
        tick=status.tick,
        speed=status.speed,
        measured_speed=status.measured_speed,
        paused=status.paused,
        stepping=status.stepping,
        participants=list(status.participants),
        waiting_for=list(status.waiting_for),
        waiting=rospy.Duration.from_sec(status.waiting),
        reason=status.reason,
    )


def _caller(request: Any) -> str:
    return str(request._connection_header["callerid"])


def _time(time_us: int) -> rospy.Time:
    seconds, micros = divmod(time_us, 1_000_000)
    return rospy.Time(seconds, micros * 1000)


def _microseconds(value: Any) -> int:
    """Return a ROS time or duration in microseconds, rounded up so that a step does not end early."""
    return -(-value.to_nsec() // 1000)
