"""What comes from outside to steer by: the OFFBOARD setpoint stream, and the shape of sticks."""

from __future__ import annotations

import math
from collections.abc import Sequence

from xtdrone_control.autopilot.state import TASK_ATTITUDE, TASK_RATES, TASK_TRAJECTORY
from xtdrone_control.autopilot.vehicle_view import VehicleView

_NAN = math.nan
_UNSET = (_NAN, _NAN, _NAN)
_STOP = (0.0, 0.0, 0.0)
_NEVER_US = -(1 << 60)


class SetpointError(ValueError):
    """A setpoint that cannot be flown; it is not stored and does not count for the stream's watchdog."""


def _finite(value: float) -> float:
    """Return ``value``, NaN in place of an infinite one."""
    return value if math.isfinite(value) else _NAN


def _can_be_flown(parts: Sequence[Sequence[float]]) -> bool:
    """Say whether position, velocity and acceleration control every axis, and x and y only in pairs.

    Source: PX4 ``PositionControl::_inputValid``.
    """
    pairs = all(math.isnan(x) == math.isnan(y) for x, y, _ in parts)
    return pairs and all(not all(map(math.isnan, axis)) for axis in zip(*parts, strict=True))


def _collective(thrust: float) -> float:
    return min(max(thrust, 0.0), 1.0) if math.isfinite(thrust) else 0.0


class OffboardInput:
    """The last setpoint of the OFFBOARD stream and the watchdog over the stream.

    Attributes:
        incomplete: the last setpoint leaves an axis without control, and the vehicle stops and waits instead.
    """

    def __init__(self, view: VehicleView) -> None:
        """Start without a setpoint."""
        self._view = view
        self._last_us = _NEVER_US
        self._previous_us = _NEVER_US
        self._task = TASK_TRAJECTORY
        self.incomplete = False
        self._fields: dict[str, Sequence[float] | float] = {}

    @property
    def needs_position(self) -> bool:
        """Whether the last setpoint is flown by the horizontal estimate."""
        return self._task == TASK_TRAJECTORY

    def fresh(self, limit: float) -> bool:
        """Return whether a setpoint came within the last ``limit`` seconds."""
        return self._view.time_us - self._last_us <= limit * 1e6

    def steady(self, limit: float) -> bool:
        """Return whether the last two setpoints came within ``limit`` seconds of each other, and of now."""
        return self.fresh(limit) and self._last_us - self._previous_us <= limit * 1e6

    def set_trajectory(
        self,
        position: Sequence[float],
        velocity: Sequence[float],
        acceleration: Sequence[float],
        yaw: float,
        yaw_rate: float,
    ) -> None:
        """Store a trajectory setpoint; what is not finite is not controlled.

        One that cannot be flown, since an axis is left without control, lets the vehicle stop and wait, as in PX4.

        Args:
            position: m, local NED, 3 values.
            velocity: m/s, local NED, 3 values.
            acceleration: m/s^2, local NED, 3 values.
            yaw: rad, local.
            yaw_rate: rad/s.

        Raises:
            SetpointError: nothing is given but NaN.
        """
        given = (position, velocity, acceleration)
        if all(math.isnan(value) for part in given for value in part):
            raise SetpointError("neither position nor velocity nor acceleration is given")
        parts = [tuple(map(_finite, part)) for part in given]
        incomplete = not _can_be_flown(parts)
        if incomplete:
            parts = [_UNSET, _STOP, _UNSET]
            yaw = yaw_rate = _NAN
        self._store(
            TASK_TRAJECTORY,
            position=parts[0],
            velocity=parts[1],
            acceleration=parts[2],
            yaw=_finite(yaw),
            yaw_rate=_finite(yaw_rate),
        )
        self.incomplete = incomplete

    def set_attitude(self, attitude: Sequence[float], yaw_rate: float, thrust: float) -> None:
        """Store an attitude setpoint.

        Args:
            attitude: quaternion (w, x, y, z), body to local; it is normalised.
            yaw_rate: rad/s, NaN for none.
            thrust: collective, cut to 0..1; none when it is not finite.

        Raises:
            SetpointError: a quaternion that is not finite, or near zero.
        """
        norm = math.sqrt(sum(c * c for c in attitude))
        if not 1e-3 < norm < 1e6:
            raise SetpointError(f"attitude has norm {norm:.3g}, not 1")
        rates = (0.0, 0.0, yaw_rate if math.isfinite(yaw_rate) else 0.0)
        self._store(TASK_ATTITUDE, attitude_q=[c / norm for c in attitude], rates=rates, thrust=_collective(thrust))

    def set_rates(self, rates: Sequence[float], thrust: float) -> None:
        """Store a setpoint of body rates (rad/s, FRD; what is not finite is not controlled) and collective thrust.

        Thrust is cut to 0..1, and none when it is not finite.
        """
        self._store(TASK_RATES, rates=tuple(map(_finite, rates)), thrust=_collective(thrust))

    def _store(self, task: int, **fields: Sequence[float] | float) -> None:
        self._task = task
        self.incomplete = False
        self._fields = fields
        self._previous_us = self._last_us
        self._last_us = self._view.time_us

    def write(self) -> None:
        """Let the cascade follow the last setpoint."""
        fields = self._view.setpoint_fields
        for name, value in self._fields.items():
            fields[name][:] = value
        if self._view.setpoint["task"] != self._task:
            self._view.start_task(self._task)


def shaped(value: float, dead_zone: float, expo: float) -> float:
    """Return a stick's value (-1..1) past its dead zone, on a curve between straight (expo 0) and cubic (1)."""
    value = min(max(value, -1.0), 1.0)
    size = abs(value) - dead_zone
    if size <= 0.0 or dead_zone >= 1.0:
        return 0.0
    size /= 1.0 - dead_zone
    return math.copysign((1.0 - expo) * size + expo * size**3, value)
