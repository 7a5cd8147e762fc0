"""OFFBOARD setpoint: the last one of the client's stream, and the watchdog of the stream."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from xtdrone_autopilot.state import TASK_ATTITUDE, TASK_RATES, TASK_TRAJECTORY
from xtdrone_autopilot.vehicle_view import Vector, VehicleView

_NAN = math.nan
_UNSET = (_NAN, _NAN, _NAN)
_HOLD = (*_UNSET, 0.0, 0.0, 0.0, *_UNSET, _NAN, _NAN)  # of ``VehicleView.setpoint_fields["trajectory"]``
_NEVER_US = -(1 << 60)


class SetpointError(ValueError):
    """Invalid setpoint; it is not stored and does not feed the watchdog of the stream."""


def _finite(value: float) -> float:
    """Return ``value``, with NaN for an infinite one."""
    return value if math.isfinite(value) else _NAN


def _can_be_flown(given: Sequence[bool]) -> bool:
    """Return whether position, velocity and acceleration together control every axis, with x and y only in pairs.

    Source: PX4 ``PositionControl::_inputValid``. ``given`` tells for each of their 9 values whether it is controlled.
    """
    x, y, z = given[0::3], given[1::3], given[2::3]
    return x == y and any(x) and any(z)


def _collective(thrust: float) -> float:
    return min(max(thrust, 0.0), 1.0) if math.isfinite(thrust) else 0.0


_Start = TypeVar("_Start")


class CommandStart(Generic[_Start]):
    """Pose of the vehicle at the start of the current relative command.

    A stream repeats its setpoint many times a second. Setpoints of equal values are one command, which starts at the
    vehicle's pose at the first of them. A new command starts when the values change, after another kind of setpoint,
    after a pause that ends the stream, and while the vehicle does not follow setpoints: a command is then relative to
    the pose at which OFFBOARD begins.
    """

    def __init__(self) -> None:
        """Start without a command."""
        self._current: tuple[Sequence[float], _Start] | None = None

    def update(self, values: Sequence[float], here: _Start, *, repeated: bool) -> _Start:
        """Return the start of the command that this setpoint belongs to.

        Args:
            values: the setpoint; NaN equals NaN.
            here: the vehicle's current pose.
            repeated: whether the setpoint continues a stream that the vehicle follows.
        """
        if self._current is None or not repeated or not _equal(self._current[0], values):
            self._current = values, here
        return self._current[1]


def _equal(a: Sequence[float], b: Sequence[float]) -> bool:
    return len(a) == len(b) and all(x == y or (x != x and y != y) for x, y in zip(a, b, strict=True))


class OffboardSetpoint:
    """Last setpoint of the OFFBOARD stream and watchdog of the stream.

    A setpoint feeds the watchdog in every mode, and is written to the control cascade while the vehicle follows it.

    Attributes:
        incomplete: the last setpoint leaves an axis uncontrolled, so that the vehicle stops and holds instead.
    """

    def __init__(self, view: VehicleView, follows: Callable[[], bool], loss_time: Callable[[], float]) -> None:
        """Start without a setpoint.

        Args:
            view: Access to the vehicle's autopilot records.
            follows: Function that returns whether the vehicle is armed in OFFBOARD.
            loss_time: Function that returns COM_OF_LOSS_T, s, the pause that ends the stream.
        """
        self._view = view
        self._follows = follows
        self._loss_time = loss_time
        self._last_us = _NEVER_US
        self._previous_us = _NEVER_US
        self._task = TASK_TRAJECTORY
        self._count = 0  # setpoints stored so far
        self._count_after_offset = 0  # value of that count once the latest vehicle-relative setpoint was stored
        self._offset_start: CommandStart[tuple[Vector, float]] = CommandStart()
        self.incomplete = False
        self._fields: dict[str, Sequence[float] | float] = {}

    @property
    def needs_position(self) -> bool:
        """Whether the last setpoint requires the horizontal position estimate."""
        return self._task == TASK_TRAJECTORY

    def fresh(self, limit: float) -> bool:
        """Return whether the last setpoint arrived within ``limit`` seconds."""
        return self._view.time_us - self._last_us <= limit * 1e6

    def steady(self, limit: float) -> bool:
        """Return whether the last setpoint and the one before it each arrived within ``limit`` seconds."""
        return self.fresh(limit) and self._last_us - self._previous_us <= limit * 1e6

    def offset_start(self, values: Sequence[float]) -> tuple[Vector, float]:
        """Return the position (m, local NED) and heading (rad) to which a vehicle-relative setpoint refers.

        Call it before the setpoint is stored. See ``CommandStart``.

        Args:
            values: Setpoint relative to the vehicle.
        """
        continues = self._follows() and self.fresh(self._loss_time())
        repeated = continues and self._count == self._count_after_offset
        self._count_after_offset = self._count + 1
        return self._offset_start.update(values, (self._view.position, self._view.yaw), repeated=repeated)

    def set_trajectory(
        self,
        position: Sequence[float],
        velocity: Sequence[float],
        acceleration: Sequence[float],
        yaw: float,
        yaw_rate: float,
    ) -> None:
        """Store a trajectory setpoint; non-finite values are uncontrolled.

        A setpoint that leaves an axis uncontrolled makes the vehicle stop and hold, as in PX4.

        Args:
            position: m, local NED, 3 values.
            velocity: m/s, local NED, 3 values.
            acceleration: m/s^2, local NED, 3 values.
            yaw: rad, local.
            yaw_rate: rad/s.

        Raises:
            SetpointError: position, velocity and acceleration are all NaN.
        """
        sent = (*position, *velocity, *acceleration)
        given = [math.isfinite(value) for value in sent]
        if not any(given) and all(map(math.isnan, sent)):
            raise SetpointError("neither position nor velocity nor acceleration is given")
        incomplete = not _can_be_flown(given)
        values = [value if finite else _NAN for value, finite in zip(sent, given, strict=True)]
        trajectory = [*values, _finite(yaw), _finite(yaw_rate)]
        self._store(TASK_TRAJECTORY, incomplete, trajectory=_HOLD if incomplete else trajectory)

    def set_attitude(self, attitude: Sequence[float], yaw_rate: float, thrust: float) -> None:
        """Store an attitude setpoint.

        Args:
            attitude: quaternion (w, x, y, z), body FRD to local NED; normalised on storage.
            yaw_rate: rad/s, NaN for none.
            thrust: collective thrust, clamped to 0..1; 0 if not finite.

        Raises:
            SetpointError: the quaternion is not finite, or its norm is close to zero.
        """
        norm = math.sqrt(sum(c * c for c in attitude))
        if not 1e-3 < norm < 1e6:
            raise SetpointError(f"attitude has norm {norm:.3g}, not 1")
        rates = (0.0, 0.0, yaw_rate if math.isfinite(yaw_rate) else 0.0)
        self._store(TASK_ATTITUDE, attitude_q=[c / norm for c in attitude], rates=rates, thrust=_collective(thrust))

    def set_rates(self, rates: Sequence[float], thrust: float) -> None:
        """Store a setpoint of body rates and collective thrust.

        Args:
            rates: body rates FRD, rad/s; non-finite values are uncontrolled.
            thrust: collective thrust, clamped to 0..1; 0 if not finite.
        """
        self._store(TASK_RATES, rates=tuple(map(_finite, rates)), thrust=_collective(thrust))

    def _store(self, task: int, incomplete: bool = False, **fields: Sequence[float] | float) -> None:
        self._task = task
        self._count += 1
        self.incomplete = incomplete
        self._fields = fields
        self._previous_us = self._last_us
        self._last_us = self._view.time_us
        if self._follows():
            self.write()

    def write(self) -> None:
        """Write the last setpoint to the control cascade."""
        fields = self._view.setpoint_fields
        for name, value in self._fields.items():
            fields[name][:] = value
        if self._view.task != self._task:
            self._view.start_task(self._task)
