"""Logic of the multirotor communication node, independent of ROS: from inputs to a setpoint and service requests.

As in XTDrone, the last input is the setpoint until the next one; a velocity or acceleration inside the dead zone means
HOVER, which holds the current pose; commands other than ``OWN_COMMANDS`` are sent to set_mode unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from xtdrone_common.modes import PX4_MODES
from xtdrone_common.settings import Settings, setting
from xtdrone_control.communication.setpoint import (
    LARGEST,
    Setpoint,
    Vector,
    acceleration_setpoint,
    first_bad_field,
    pose_setpoint,
    velocity_setpoint,
    yaw_of,
)

OWN_COMMANDS = ("ARM", "DISARM", "HOVER")

HOVER_SPEED = 0.001  # m/s (m/s^2 for accelerations), on each axis: a tenth of a press of the keyboard; XTDrone: 0.02
HOVER_YAW_RATE = 0.005  # rad/s
STATE_GRACE = 2.5  # s; mavros/state follows the 1 Hz heartbeat, one of which may be lost

# modes that PX4 enters when the commanded one is complete: they count as the commanded state
_SUCCESSORS = {"AUTO.TAKEOFF": ("AUTO.LOITER",)}

_TWIST_FIELDS = ("linear.x", "linear.y", "linear.z", "angular.z")
_POSE_FIELDS = (
    "position.x",
    "position.y",
    "position.z",
    "orientation.x",
    "orientation.y",
    "orientation.z",
    "orientation.w",
)


@dataclass(frozen=True)
class CommandSettings(Settings):
    """Interpretation of velocity and acceleration commands."""

    hover_speed: float = setting(
        HOVER_SPEED,
        low=0.0,
        high=LARGEST,
        unit="m/s",
        text="a velocity (or acceleration, m/s^2) command that does not exceed this on any axis, with a yaw rate up to "
        f"{HOVER_YAW_RATE:g} rad/s, means HOVER",
    )
    cmd_timeout: float = setting(
        0.0,
        low=0.0,
        high=LARGEST,
        unit="s",
        text="a velocity or acceleration command older than this turns into HOVER, 0 for never",
    )


class Log(Protocol):
    """Destination of log messages."""

    def info(self, text: str) -> None:
        """Log a completed action."""

    def warning(self, text: str) -> None:
        """Log a rejection or a failure."""

    def stream_warning(self, text: str) -> None:
        """Warn about a stream of messages; identical texts are throttled."""


@dataclass(frozen=True)
class CommandRequest:
    """A service call requested by a command.

    Attributes:
        command: the command string as received.
        arm: True or False for the arming service, None for set_mode.
    """

    command: str
    arm: bool | None

    @property
    def service(self) -> str:
        """Service name below the vehicle's namespace."""
        return "mavros/set_mode" if self.arm is None else "mavros/cmd/arming"


@dataclass(frozen=True)
class Steady:
    """State of a core whose setpoint changes only by velocity and acceleration commands; poses only update its pose.

    Attributes:
        hover_speed: m/s, see :class:`CommandSettings`.
        cmd_timeout: s, see :class:`CommandSettings`.
        hovering: whether the setpoint is a captured pose.
        moving_since: time of the last velocity or acceleration, s; None while the setpoint is neither.
        mode: flight mode in mavros/state; None before the first message.
        armed: arming state in mavros/state.
    """

    hover_speed: float
    cmd_timeout: float
    hovering: bool
    moving_since: float | None
    mode: str | None
    armed: bool


class MultirotorCore:
    """Setpoint and commands of one multirotor.

    OFFBOARD can be entered only with a stream of setpoints, so one is always published. Before any input it holds the
    vehicle at its current pose, which is updated until OFFBOARD is entered and fixed from then on; before the first
    pose it is velocity zero.

    A repeated command is ignored only while the vehicle is in the commanded state: it is sent again after a rejection,
    and when mavros/state shows that the vehicle has left that state (after a failsafe, for example).

    Attributes:
        setpoint: the setpoint to publish.
        hovering: whether ``setpoint`` is a captured pose, which further zero velocities do not change.
        mission: the one-character mission label of the last ``mission?`` command, empty before.
    """

    def __init__(self, name: str, log: Log, *, hover_speed: float = HOVER_SPEED, cmd_timeout: float = 0.0) -> None:
        """Start holding.

        Args:
            name: name of the vehicle, such as ``iris_0``, for messages.
            log: destination of log messages.
            hover_speed: m/s (m/s^2 for accelerations), see :class:`CommandSettings`. XTDrone's 0.02 ignores the first
                two key presses of its keyboard and stops a formation up to 2 cm per axis and layer of the topology
                away from its slots; with 0 only exactly zero means HOVER.
            cmd_timeout: s, see :class:`CommandSettings`.

        Raises:
            SettingError: ``hover_speed`` or ``cmd_timeout`` is not allowed.
        """
        settings = CommandSettings(hover_speed=hover_speed, cmd_timeout=cmd_timeout)
        self.name = name
        self._log = log
        self._hover_speed = settings.hover_speed
        self._cmd_timeout = settings.cmd_timeout
        self.restart()

    def restart(self) -> None:
        """Reset to the initial state: hold, without any input."""
        self.setpoint = velocity_setpoint((0.0, 0.0, 0.0), 0.0, body=False)
        self.hovering = False
        self.mission = ""
        self._pose: tuple[Vector, float] | None = None  # position ENU m, yaw rad
        self._idle = True  # no input and no HOVER yet: the hold follows the vehicle
        self._moving_since: float | None = None  # time of the last velocity or acceleration, while it is the setpoint
        self._mode: str | None = None
        self._armed: bool | None = None
        self._request: CommandRequest | None = None  # the last command with a service call
        self._last = ""  # the last command of any kind
        self._pending = False
        self._accepted_at: float | None = None
        self._confirmed = False  # mavros/state has shown the commanded state since

    @property
    def mode(self) -> str:
        """Flight mode in mavros/state; empty before the first message."""
        return self._mode or ""

    @property
    def armed(self) -> bool:
        """Arming state in mavros/state; False before the first message."""
        return bool(self._armed)

    @property
    def pose(self) -> tuple[Vector, float] | None:
        """Local position, m ENU, and yaw, rad ENU; None before the first pose."""
        return self._pose

    @property
    def holding(self) -> bool:
        """Whether the vehicle is holding position rather than following a commanded setpoint."""
        return self.hovering or (self._idle and self._pose is not None)

    def steady(self) -> Steady | None:
        """Return the state if only velocity and acceleration commands can now change the setpoint, else None.

        While ``mavros/state`` repeats mode and arming state, the core then ignores it.
        """
        if self._idle or (self._accepted_at is not None and not self._confirmed):
            return None
        return Steady(self._hover_speed, self._cmd_timeout, self.hovering, self._moving_since, self._mode, self.armed)

    # vehicle state

    def on_pose(self, position: Vector, quaternion: tuple[float, float, float, float]) -> None:
        """Store the local pose: m ENU, quaternion (x, y, z, w). Non-finite poses are ignored."""
        bad = first_bad_field(_POSE_FIELDS, (*position, *quaternion))
        if bad is not None:
            self._log.stream_warning(f"/{self.name}/mavros/local_position/pose: {bad}; pose ignored")
            return
        self._pose = (position, yaw_of(*quaternion))
        if self._idle and not self._in_offboard():
            self.setpoint = pose_setpoint(*self._pose, body=False)

    def on_state(self, mode: str, armed: bool) -> None:
        """Store mode and arming state of mavros/state."""
        self._mode, self._armed = mode, armed
        if self._accepted_at is not None and self._matches():
            self._confirmed = True

    # commands of the user

    def on_command(self, text: str, now: float) -> CommandRequest | None:
        """Handle a string of the cmd topic; return the service call to make, if any.

        Args:
            text: the command.
            now: s, ROS time.
        """
        if text in ("", "stop controlling") or (text == self._last and self._holds(now)):
            return None
        self._last = text
        if text == "HOVER":
            self._hover_on_command()
            return None
        if len(text) == len("mission?") and text.startswith("mission"):
            self.mission = text[-1]
            self._log.info(f"{self.name}: mission {self.mission}")
            return None
        self._request = CommandRequest(text, {"ARM": True, "DISARM": False}.get(text))
        self._pending, self._accepted_at, self._confirmed = True, None, False
        return self._request

    def on_result(self, request: CommandRequest, accepted: bool, reason: str, now: float) -> None:
        """Handle the result of a service call.

        Args:
            request: the request.
            accepted: success field of the response (not merely that a response was received).
            reason: reason of a rejection, or empty.
            now: s, ROS time.
        """
        if request is self._request:
            self._pending = False
            self._accepted_at = now if accepted else None
        if accepted:
            if request.arm is None:
                self.hovering = False  # the new mode moves the vehicle: a later HOVER must capture its pose again
            self._log.info(f"{self.name}: {request.command} accepted")
            return
        text = f"{self.name}: {request.command} refused by {request.service}"
        if reason:
            text += f" ({reason})"
        if request.arm is None and request.command not in PX4_MODES:
            text += f"; it is no command ({', '.join(OWN_COMMANDS)}) and no PX4 mode ({', '.join(PX4_MODES)})"
        self._log.warning(text)

    def on_target_pose(
        self, topic: str, position: Vector, quaternion: tuple[float, float, float, float], *, body: bool
    ) -> None:
        """Apply a cmd_pose message: position in m, ENU, or offset in FLU; quaternion (x, y, z, w)."""
        if self._is_valid(topic, _POSE_FIELDS, (*position, *quaternion)):
            self._set(pose_setpoint(position, yaw_of(*quaternion), body=body), moving_since=None)

    def on_target_velocity(self, topic: str, velocity: Vector, yaw_rate: float, now: float, *, body: bool) -> None:
        """Apply a cmd_vel message: m/s ENU or FLU, rad/s; inside the dead zone it means HOVER."""
        if self._is_valid(topic, _TWIST_FIELDS, (*velocity, yaw_rate)) and not self._dead_zone(velocity, yaw_rate):
            self._set(velocity_setpoint(velocity, yaw_rate, body=body), moving_since=now)

    def on_target_acceleration(
        self, topic: str, acceleration: Vector, yaw_rate: float, now: float, *, body: bool
    ) -> None:
        """Apply a cmd_accel message: m/s^2 ENU or FLU, rad/s; inside the dead zone it means HOVER."""
        values = (*acceleration, yaw_rate)
        if self._is_valid(topic, _TWIST_FIELDS, values) and not self._dead_zone(acceleration, yaw_rate):
            self._set(acceleration_setpoint(acceleration, yaw_rate, body=body), moving_since=now)

    def brake(self) -> None:
        """Set velocity zero: unlike HOVER, the vehicle does not return to the place where it began to brake."""
        self._set(velocity_setpoint((0.0, 0.0, 0.0), 0.0, body=False), moving_since=None)

    def tick(self, now: float) -> Setpoint:
        """Return the setpoint to publish at ``now`` (s, ROS time)."""
        if self._moving_since is not None and 0.0 < self._cmd_timeout < now - self._moving_since:
            self._log.warning(f"{self.name}: no velocity or acceleration for {self._cmd_timeout} s: HOVER")
            self._hover()
        self._check_late_state(now)
        return self.setpoint

    # internals

    def _set(self, setpoint: Setpoint, moving_since: float | None) -> None:
        self.setpoint = setpoint
        self.hovering = False
        self._idle = False
        self._moving_since = moving_since

    def _hover(self) -> bool:
        """Hold the current pose, or velocity zero before the first pose; return whether a pose was captured."""
        if self._pose is None:
            self._set(velocity_setpoint((0.0, 0.0, 0.0), 0.0, body=False), moving_since=None)
            return False
        self._set(pose_setpoint(*self._pose, body=False), moving_since=None)
        self.hovering = True
        return True

    def _hover_on_command(self) -> None:
        if self._hover():
            self._log.info(f"{self.name}: HOVER")
        else:
            self._log.warning(
                f"{self.name}: HOVER: no pose received yet on /{self.name}/mavros/local_position/pose yet; "
                "velocity zero is set instead"
            )

    def _dead_zone(self, vector: Vector, yaw_rate: float) -> bool:
        """Return whether the input means HOVER; capture the pose unless already hovering."""
        x, y, z = vector
        limit = self._hover_speed
        if abs(x) > limit or abs(y) > limit or abs(z) > limit or abs(yaw_rate) > HOVER_YAW_RATE:
            return False
        if not self.hovering:
            self._hover()
        return True

    def _is_valid(self, topic: str, names: tuple[str, ...], values: tuple[float, ...]) -> bool:
        bad = first_bad_field(names, values)
        if bad is not None:
            self._log.stream_warning(f"{topic}: {bad}; message ignored, finite values within +-{LARGEST:g} are allowed")
        return bad is None

    def _in_offboard(self) -> bool:
        if self._mode is not None:
            return self._mode == "OFFBOARD"
        return self._accepted_at is not None and self._request is not None and self._request.command == "OFFBOARD"

    def _matches(self) -> bool:
        """Return whether mavros/state shows the state commanded last by a service call."""
        assert self._request is not None
        if self._request.arm is not None:
            return self._armed == self._request.arm
        wanted = self._request.command
        return self._mode == wanted or self._mode in _SUCCESSORS.get(wanted, ())

    def _holds(self, now: float) -> bool:
        """Return whether the vehicle is still in the state of the last command, which makes a repetition redundant."""
        if self._last == "HOVER":
            return self.hovering
        if self._request is None or self._request.command != self._last:
            return True  # a mission label
        if self._pending:
            return True
        if self._accepted_at is None:
            return False
        if self._mode is None or self._matches():
            return True
        return not self._confirmed and now - self._accepted_at <= STATE_GRACE

    def _check_late_state(self, now: float) -> None:
        """Warn once if mavros/state does not show an accepted command: MAVROS replies on sending, not on success."""
        if self._accepted_at is None or self._confirmed or self._mode is None or self._request is None:
            return
        if now - self._accepted_at > STATE_GRACE:
            actual = self._mode if self._request.arm is None else ("armed" if self._armed else "disarmed")
            self._log.warning(
                f"{self.name}: {self._request.command} was accepted but mavros/state still says {actual} "
                f"after {STATE_GRACE} s"
            )
            self._accepted_at = None
