"""The verbs of a scripted vehicle, without ROS: generators that are advanced once a turn until they return or raise."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from xtdrone_control.communication.commands import CommandRequest, MultirotorCore
from xtdrone_control.communication.setpoint import LARGEST, Vector

Steps = Iterator[None]
"""A running verb. Each step is one turn."""

MODE_LIMIT = 5.0  # s for mavros/state, which follows the 1 Hz heartbeat, to show a mode or an arming state
ANSWER_LIMIT = 15.0  # s for MAVROS to answer a service call; it waits some seconds for the autopilot itself
STREAM_LEAD = 0.5  # s of setpoints before OFFBOARD is requested; PX4 rejects it without a stream
TEXT_GRACE = 1.0  # s after a rejection during which the autopilot's explanation may still arrive
ARRIVED_SPEED = 0.5  # m/s below which a vehicle at its goal has arrived, and one that brakes has stopped
BRAKE_LIMIT = 4.0  # s; then a velocity estimate without aiding is no longer worth waiting for
LEAST_PROGRESS = 0.5  # m/s: the default timeout allows for this mean speed
_WARNING = 4  # MAV_SEVERITY; texts of this severity or worse explain a rejection
_ERROR = 2  # DiagnosticStatus.ERROR
_PREARM_CHECK = 1 << 28  # MAV_SYS_STATUS_PREARM_CHECK

_ARM, _DISARM = CommandRequest("ARM", True), CommandRequest("DISARM", False)


class DroneError(Exception):
    """Error of a verb that failed.

    Attributes:
        vehicle: name, such as ``iris_0``; comma-separated names if several vehicles failed.
        verb: name of the verb.
        reason: why the verb failed, with the autopilot's last warning if there was one.
    """

    def __init__(self, vehicle: str, verb: str, reason: str) -> None:
        """Compose the message ``vehicle: verb: reason``."""
        super().__init__(f"{vehicle}: {verb}: {reason}")
        self.vehicle = vehicle
        self.verb = verb
        self.reason = reason


class RejectedError(DroneError):
    """The autopilot has rejected a command."""


class TimedOutError(DroneError):
    """The verb was not done within its timeout."""


class FaultError(DroneError):
    """A component named to ``watch`` reports an error."""


class GroupError(DroneError):
    """Error of a verb that failed for several vehicles.

    Attributes:
        errors: one for each vehicle that failed.
    """

    def __init__(self, errors: list[DroneError]) -> None:
        """Join the messages."""
        super().__init__(
            ", ".join(error.vehicle for error in errors), errors[0].verb, "; ".join(str(error) for error in errors)
        )
        self.errors = errors


@dataclass
class Telemetry:
    """Telemetry from the vehicle's MAVROS other than mode, arming state and pose.

    Attributes:
        connected: whether MAVROS receives the autopilot's heartbeat.
        velocity: m/s ENU; None before the first message.
        battery: remaining charge, 0..1; NaN if unknown.
        sensors_present, sensors_health: bits of SYS_STATUS.
        warnings: the autopilot's latest STATUSTEXTs of severity WARNING or worse, with the times of their arrival, s.
    """

    connected: bool = False
    velocity: Vector | None = None
    battery: float = math.nan
    sensors_present: int = 0
    sensors_health: int = 0
    warnings: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=20))


class Verbs:
    """The verbs of one vehicle.

    Attributes:
        name: Name of the vehicle, such as ``iris_0``.
        core: computes the setpoint that is streamed during a verb.
        telemetry: the vehicle's latest reports.
        resets: number of resets of simulated time.
    """

    def __init__(
        self, name: str, core: MultirotorCore, submit: Callable[[CommandRequest], None], now: Callable[[], float]
    ):
        """Start without telemetry.

        Args:
            name: Name of the vehicle.
            core: Core of the vehicle; the caller gives it state and pose.
            submit: starts a service call, whose outcome is passed to ``on_result``.
            now: returns ROS time, s.
        """
        self.name = name
        self.core = core
        self.telemetry = Telemetry()
        self.resets = 0
        self._submit = submit
        self._now = now
        self._streaming_since: float | None = None
        self._requested: CommandRequest | None = None
        self._outcomes: list[tuple[bool, str]] = []
        self._watched: dict[str, float] = {}  # component to patience, s
        self._faults: dict[str, tuple[float, str]] = {}  # component in error to the time since when, s, and its text

    # inputs

    def on_setpoint(self) -> None:
        """Record that a setpoint was published which MAVROS receives."""
        if self._streaming_since is None:
            self._streaming_since = self._now()

    def on_result(self, request: CommandRequest, accepted: bool, reason: str) -> None:
        """Store the outcome of the latest service call."""
        if request is self._requested:
            self._outcomes.append((accepted, reason))

    def on_text(self, severity: int, text: str) -> None:
        """Store a STATUSTEXT of MAV_SEVERITY ``severity`` if it is a warning or worse."""
        if severity <= _WARNING:
            self.telemetry.warnings.append((self._now(), text.strip()))

    def on_diagnostic(self, name: str, level: int, text: str) -> None:
        """Store a status of /diagnostics if it is of a watched component.

        Args:
            name: ``VEHICLE: COMPONENT``.
            level: Level of DiagnosticStatus: 0 OK, 1 WARN, 2 ERROR, 3 STALE.
            text: the message.
        """
        vehicle, _, component = name.partition(": ")
        if vehicle != self.name or component not in self._watched:
            return
        if level >= _ERROR:
            since, _ = self._faults.get(component, (self._now(), ""))
            self._faults[component] = since, text
        else:
            self._faults.pop(component, None)

    def on_reset(self) -> None:
        """Discard all state, because simulated time was reset."""
        self.telemetry = Telemetry()
        self._faults.clear()
        self.resets += 1
        self._streaming_since = self._requested = None

    def watch(self, components: Sequence[str], patience: float) -> None:
        """Make verbs that fly raise ``FaultError`` while one of these components reports an error.

        Args:
            components: names without the vehicle's.
            patience: s for which the error must have lasted.
        """
        self._watched.update(dict.fromkeys(components, patience))

    # verbs

    def connect(self, timeout: float) -> Steps:
        """Wait for the vehicle's state and pose."""
        verb = "connect"
        yield from self._until(
            verb, lambda: self.telemetry.connected, timeout, f"no autopilot on {self._topic('state')}"
        )
        yield from self._until(
            verb, lambda: self.core.pose is not None, timeout, f"no position on {self._topic('local_position/pose')}"
        )

    def arm(self, timeout: float) -> Steps:
        """Wait until the autopilot is ready, then arm.

        The request is sent once, at the timeout at the latest, so that a rejection tells the reason.
        """
        if self.core.armed:
            return
        self._hold_here()
        began = self._now()
        while (not self._ready() or self._faults) and self._now() - began < timeout:
            yield
        self._check_watched("arm", patient=False)
        yield from self._request("arm", _ARM)
        yield from self._until("arm", lambda: self.core.armed, MODE_LIMIT, "accepted, but the vehicle is not armed")

    def disarm(self) -> Steps:
        """Disarm on the ground."""
        yield from self._request("disarm", _DISARM)
        yield from self._until("disarm", lambda: not self.core.armed, MODE_LIMIT, "accepted, but it is still armed")

    def takeoff(self, height: float, tolerance: float, timeout: float | None) -> Steps:
        """Climb in OFFBOARD to ``height`` m above the current position."""
        (x, y, z), heading = self._pose("takeoff")
        goal = z + height

        def arrived() -> bool:
            return self.core.pose is not None and abs(self.core.pose[0][2] - goal) <= tolerance

        yield from self._fly_to("takeoff", (x, y, goal), heading, arrived, timeout)

    def go_to(self, position: Vector, heading: float | None, tolerance: float, timeout: float | None) -> Steps:
        """Fly in OFFBOARD to ``position``, m ENU, and turn to ``heading``, rad; None keeps the current one."""
        if heading is None:
            heading = self._pose("go_to")[1]
        yield from self._fly_to("go_to", position, heading, lambda: self._has_arrived(position, tolerance), timeout)

    def set_velocity(self, velocity: Vector, yaw_rate: float, *, body: bool) -> Steps:
        """Fly with ``velocity`` m/s, ENU or FLU when ``body``, from now on."""
        self._check_armed("set_velocity")
        self.core.on_target_velocity(f"{self.name}: set_velocity", velocity, yaw_rate, self._now(), body=body)
        yield from self._offboard("set_velocity")

    def hold(self) -> Steps:
        """Hold the current position in OFFBOARD."""
        self._check_armed("hold")
        self._hold_here()
        yield from self._offboard("hold")

    def brake(self) -> Steps:
        """Stop with velocity zero in OFFBOARD, whatever a watched component reports."""
        self._check_armed("brake")
        self.core.brake()
        yield from self._offboard("brake")
        began = self._now()
        while self._speed() >= ARRIVED_SPEED and self._now() - began < BRAKE_LIMIT:
            self._check_mode("brake", began)
            yield

    def land(self, timeout: float) -> Steps:
        """Land here, and wait until the autopilot has disarmed."""
        if not self.core.armed:
            return
        yield from self.set_mode("AUTO.LAND", "land")
        began = self._now()
        while self.core.armed:
            if self.core.mode != "AUTO.LAND":
                raise DroneError(self.name, "land", f"mode changed to {self.core.mode}{self._why(began)}")
            if self._now() - began >= timeout:
                raise TimedOutError(
                    self.name, "land", f"not landed and disarmed within {timeout:g} s{self._why(began)}"
                )
            yield

    def set_mode(self, mode: str, verb: str = "set_mode") -> Steps:
        """Switch to a flight mode, given by its name in MAVROS, such as ``AUTO.RTL``."""
        if self.core.mode == mode:
            return
        began = self._now()
        yield from self._request(verb, CommandRequest(mode, None))
        while self.core.mode != mode:
            if self._now() - began >= MODE_LIMIT:
                raise RejectedError(self.name, verb, f"the mode stays {self.core.mode}, not {mode}{self._why(began)}")
            yield

    def wait(self, seconds: float) -> Steps:
        """Wait ``seconds`` of ROS time; a vehicle in OFFBOARD must stay in it."""
        began, offboard = self._now(), self.core.mode == "OFFBOARD" and self.core.armed
        while self._now() - began < seconds:
            if offboard:
                self._check_offboard("wait", began)
            yield

    # parts of verbs

    def _fly_to(
        self, verb: str, goal: Vector, heading: float, arrived: Callable[[], bool], timeout: float | None
    ) -> Steps:
        self._check_armed(verb)
        began = self._now()
        way = math.dist(self._pose(verb)[0], goal)
        limit = 20.0 + way / LEAST_PROGRESS if timeout is None else timeout
        quaternion = (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
        self.core.on_target_pose(f"{self.name}: {verb}", goal, quaternion, body=False)
        yield from self._offboard(verb)
        while not arrived():
            self._check_offboard(verb, began)
            if self._now() - began >= limit:
                left = math.dist(self._pose(verb)[0], goal)
                raise TimedOutError(self.name, verb, f"{left:.1f} m from the goal after {limit:g} s{self._why(began)}")
            yield

    def _has_arrived(self, goal: Vector, tolerance: float) -> bool:
        pose = self.core.pose
        if pose is None or math.dist(pose[0], goal) > tolerance:
            return False
        return self._speed() < ARRIVED_SPEED

    def _speed(self) -> float:
        """Return the speed, m/s; 0 if it is unknown."""
        velocity = self.telemetry.velocity
        return 0.0 if velocity is None else math.hypot(*velocity)

    def _hold_here(self) -> None:
        """Stream the current pose: in OFFBOARD an earlier setpoint would move the vehicle as soon as it is armed."""
        self.core.on_command("HOVER", self._now())

    def _offboard(self, verb: str) -> Steps:
        topic = self._topic("setpoint_raw/local")
        yield from self._until(verb, lambda: self._streaming_since is not None, MODE_LIMIT, f"nothing receives {topic}")
        while self._streaming_since is None or self._now() - self._streaming_since < STREAM_LEAD:
            yield
        yield from self.set_mode("OFFBOARD", verb)

    def _check_armed(self, verb: str) -> None:
        if not self.core.armed:
            raise DroneError(self.name, verb, "the vehicle is not armed; call arm() first")

    def _check_offboard(self, verb: str, since: float) -> None:
        self._check_mode(verb, since)
        self._check_watched(verb)

    def _check_watched(self, verb: str, *, patient: bool = True) -> None:
        now = self._now()
        for component, (since, text) in self._faults.items():
            if not patient or now - since >= self._watched[component]:
                raise FaultError(self.name, verb, f"{component}: {text}")

    def _check_mode(self, verb: str, since: float) -> None:
        if not self.core.armed:
            raise DroneError(self.name, verb, f"the vehicle has disarmed{self._why(since)}")
        if self.core.mode != "OFFBOARD":
            raise DroneError(self.name, verb, f"mode changed from OFFBOARD to {self.core.mode}{self._why(since)}")

    def _pose(self, verb: str) -> tuple[Vector, float]:
        if self.core.pose is None:
            raise DroneError(self.name, verb, f"no position on {self._topic('local_position/pose')}")
        return self.core.pose

    def _ready(self) -> bool:
        """Return whether the autopilot passes its prearm checks; one that does not report them counts as ready."""
        present, health = self.telemetry.sensors_present, self.telemetry.sensors_health
        return present != 0 and bool(health & _PREARM_CHECK or not present & _PREARM_CHECK)

    def _request(self, verb: str, request: CommandRequest) -> Steps:
        began = self._now()
        self._outcomes.clear()
        self._requested = replace(request)  # a copy, so that an earlier call's late answer is not taken for this one's
        self._submit(self._requested)
        yield from self._until(verb, lambda: bool(self._outcomes), ANSWER_LIMIT, "no answer from MAVROS")
        accepted, reason = self._outcomes[0]
        if accepted:
            return
        rejected = self._now()
        while not self._why(began) and self._now() - rejected < TEXT_GRACE:
            yield
        text = f"rejected ({reason})" if reason else "rejected"
        raise RejectedError(self.name, verb, f"{text}{self._why(began)}")

    def _until(self, verb: str, condition: Callable[[], bool], timeout: float, problem: str) -> Steps:
        began = self._now()
        while not condition():
            if self._now() - began >= timeout:
                raise TimedOutError(self.name, verb, f"{problem} within {timeout:g} s{self._why(began)}")
            yield

    def _why(self, since: float) -> str:
        """Return the autopilot's warnings after ``since`` (s), ready to be appended to a reason."""
        texts = dict.fromkeys(text for time, text in self.telemetry.warnings if time > since)
        return f": {'; '.join(texts)}" if texts else ""

    def _topic(self, name: str) -> str:
        return f"/{self.name}/mavros/{name}"


def check_numbers(verb: str, **values: float) -> None:
    """Check the arguments of a verb.

    Raises:
        ValueError: a value is not finite or beyond +-1e6.
    """
    for name, value in values.items():
        if not abs(value) <= LARGEST:  # false for NaN
            raise ValueError(f"{verb}: {name} = {value} is not allowed, a finite number within +-{LARGEST:g}")


def check_positive(verb: str, **values: float | None) -> None:
    """Check arguments of a verb that must be positive where they are given.

    Raises:
        ValueError: a value is not in (0, 1e6].
    """
    for name, value in values.items():
        if value is not None and not 0.0 < value <= LARGEST:
            raise ValueError(f"{verb}: {name} = {value} is not allowed, more than 0 and at most {LARGEST:g}")
