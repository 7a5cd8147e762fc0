"""Control inputs: the OFFBOARD setpoint stream and the shaping of sticks."""

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
    """Invalid setpoint; it is not stored and does not feed the watchdog of the stream."""


def _finite(value: float) -> float:
    """Return ``value``, with NaN for an infinite one."""
    return value if math.isfinite(value) else _NAN


def _can_be_flown(parts: Sequence[Sequence[float]]) -> bool:
    """Return whether position, velocity and acceleration together control every axis, with x and y only in pairs.

    Source: PX4 ``PositionControl::_inputValid``.
    """
    x, y, z = ([not math.isnan(value) for value in axis] for axis in zip(*parts, strict=True))
    return x == y and any(x) and any(z)


def _collective(thrust: float) -> float:
    return min(max(thrust, 0.0), 1.0) if math.isfinite(thrust) else 0.0


class OffboardInput:
    """Last setpoint of the OFFBOARD stream and watchdog of the stream.

    Attributes:
        incomplete: the last setpoint leaves an axis uncontrolled, so that the vehicle stops and holds instead.
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
        """Whether the last setpoint requires the horizontal position estimate."""
        return self._task == TASK_TRAJECTORY

    def fresh(self, limit: float) -> bool:
        """Return whether the last setpoint arrived within ``limit`` seconds."""
        return self._view.time_us - self._last_us <= limit * 1e6

    def steady(self, limit: float) -> bool:
        """Return whether the last setpoint and the one before it each arrived within ``limit`` seconds."""
        return self.fresh(limit) and self._last_us - self._previous_us <= limit * 1e6

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

    def _store(self, task: int, **fields: Sequence[float] | float) -> None:
        self._task = task
        self.incomplete = False
        self._fields = fields
        self._previous_us = self._last_us
        self._last_us = self._view.time_us

    def write(self) -> None:
        """Write the last setpoint to the control cascade."""
        fields = self._view.setpoint_fields
        for name, value in self._fields.items():
            fields[name][:] = value
        if self._view.task != self._task:
            self._view.start_task(self._task)


def shaped(value: float, dead_zone: float, expo: float) -> float:
    """Return a stick value (-1..1) after dead zone and exponential curve, linear (expo 0) to cubic (expo 1)."""
    value = min(max(value, -1.0), 1.0)
    size = abs(value) - dead_zone
    if size <= 0.0 or dead_zone >= 1.0:
        return 0.0
    size /= 1.0 - dead_zone
    return math.copysign((1.0 - expo) * size + expo * size**3, value)
