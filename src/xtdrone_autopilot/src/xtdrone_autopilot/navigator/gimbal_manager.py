"""Gimbal setpoint and control authority: PX4's gimbal manager (MAVLink gimbal protocol v2).

Source: https://mavlink.io/en/services/gimbal_v2.html. Angles are roll, pitch, yaw in rad: roll and pitch from the
horizon, pitch positive up, yaw from the heading. Roll and pitch are always stabilised, so their lock flags are always
set. Yaw follows the vehicle, or keeps its direction over the ground while yaw lock is set.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from xtdrone_autopilot.vehicle_view import Vector, VehicleView

Controller = tuple[int, int]
"""MAVLink system and component id; (0, 0) for no controller."""

NO_CONTROLLER: Controller = (0, 0)
RETRACT, NEUTRAL, ROLL_LOCK, PITCH_LOCK, YAW_LOCK = 1, 2, 4, 8, 16  # GIMBAL_MANAGER_FLAGS
YAW_IN_VEHICLE_FRAME, YAW_IN_EARTH_FRAME = 32, 64
_LOCKED = YAW_LOCK | YAW_IN_EARTH_FRAME

_LEVEL: Vector = (0.0, 0.0, 0.0)
_UNSET: Vector = (math.nan, math.nan, math.nan)
_MAX_PITCH = 0.5 * math.pi  # rad, limit of a pitch setpoint that changes at a rate
_MODE_RETRACT, _MODE_NEUTRAL, _MODE_ANGLES, _MODE_LOCATION = 0, 1, 2, 4  # MAV_MOUNT_MODE
_UNCHANGED, _SENDER, _RELEASE = (0, -1), -2, -3  # of DO_GIMBAL_MANAGER_CONFIGURE
_MAX_ID = 255


class GimbalManager:
    """Gimbal setpoint of one vehicle.

    Attributes:
        primary, secondary: controllers under gimbal protocol v2. Missions and DO_MOUNT_CONTROL predate the protocol
            and need no control authority.
        flags: current GIMBAL_MANAGER_FLAGS.
    """

    def __init__(self, view: VehicleView) -> None:
        """Start without a setpoint and without a controller."""
        self._view = view
        self.primary = self.secondary = NO_CONTROLLER
        self.flags = ROLL_LOCK | PITCH_LOCK
        self._angles = _UNSET
        self._rates = (0.0, 0.0)  # of pitch and yaw, rad/s
        self._since_us = 0
        self._tracked: Vector | None = None  # target to track, m, local NED

    @property
    def angles(self) -> Vector:
        """Current setpoint of roll, pitch and yaw, rad; NaN before the first setpoint."""
        if self._tracked is not None:
            return self._angles_towards(self._tracked)
        roll, pitch, yaw = self._advanced_angles()
        if self.flags & YAW_LOCK:
            yaw -= self._view.yaw
        return roll, pitch, math.remainder(yaw, 2.0 * math.pi)

    def _advanced_angles(self) -> Vector:
        """Return the commanded angles advanced by the commanded rates, rad; yaw from north while locked."""
        roll, pitch, yaw = self._angles
        seconds = (self._view.time_us - self._since_us) * 1e-6
        pitch_rate, yaw_rate = self._rates
        if pitch_rate != 0.0:
            pitch = min(max(pitch + pitch_rate * seconds, -_MAX_PITCH), _MAX_PITCH)
        return roll, pitch, yaw + yaw_rate * seconds

    def _angles_towards(self, position: Vector) -> Vector:
        north, east, down = (a - b for a, b in zip(position, self._view.position, strict=True))
        bearing = math.atan2(east, north)
        return 0.0, math.atan2(-down, math.hypot(north, east)), math.remainder(bearing - self._view.yaw, 2.0 * math.pi)

    # setpoints

    def look(self, angles: Vector, flags: int = 0, rates: tuple[float, float] = (0.0, 0.0)) -> None:
        """Set the angles and rates.

        Args:
            angles: roll, pitch, yaw, rad; yaw from north with YAW_LOCK. A non-finite angle keeps its current value.
            flags: GIMBAL_MANAGER_FLAGS.
            rates: rates of pitch and yaw starting from ``angles``, rad/s; non-finite for none.
        """
        now = tuple(0.0 if math.isnan(angle) else angle for angle in self.angles)
        lock = bool(flags & _LOCKED)
        self.flags = flags & (RETRACT | NEUTRAL) | ROLL_LOCK | PITCH_LOCK | (YAW_LOCK if lock else 0)
        if flags & (RETRACT | NEUTRAL):
            self.flags &= ~YAW_LOCK
            angles, rates = _LEVEL, (0.0, 0.0)
        elif lock:
            now = now[0], now[1], now[2] + self._view.yaw
        roll, pitch, yaw = (a if math.isfinite(a) else b for a, b in zip(angles, now, strict=True))
        self._angles = roll, pitch, yaw
        pitch_rate, yaw_rate = (rate if math.isfinite(rate) else 0.0 for rate in rates)
        self._rates = pitch_rate, yaw_rate
        self._since_us = self._view.time_us
        self._tracked = None

    def look_at(self, position: Vector | None) -> None:
        """Track a position (m, local NED), or hold the current angles relative to the vehicle (None)."""
        if position is None:
            if self._tracked is not None:
                self.look(self.angles)
        elif all(map(math.isfinite, position)):
            self._tracked = position

    def mount(self, p: Sequence[float]) -> bool:
        """Execute DO_MOUNT_CONTROL with seven finite parameters; return whether its mode is supported."""
        mode = round(p[6])
        if mode in (_MODE_RETRACT, _MODE_NEUTRAL):
            self.look(_LEVEL, NEUTRAL)
        elif mode == _MODE_ANGLES:
            self.look((math.radians(p[1]), math.radians(p[0]), math.radians(p[2])))
        elif mode == _MODE_LOCATION:
            self.look_at(self._view.to_local(p[4], p[5], p[3]))
        else:
            return False
        return True

    def pitch_yaw(self, p: Sequence[float]) -> None:
        """Execute DO_GIMBAL_MANAGER_PITCHYAW; parameters in degrees, degrees/s and flags, NaN where omitted."""
        pitch, yaw, pitch_rate, yaw_rate = (math.radians(value) for value in p[:4])
        flags = int(p[4]) if math.isfinite(p[4]) and 0.0 <= p[4] < 1 << 31 else 0
        self.look((0.0, pitch, yaw), flags, (pitch_rate, yaw_rate))

    # control authority

    def configure(self, sender: Controller, p: Sequence[float]) -> None:
        """Execute DO_GIMBAL_MANAGER_CONFIGURE, which assigns primary and secondary control.

        Args:
            sender: sender of the command.
            p: parameters of the command: system and component id of the primary, then of the secondary controller. As
                system id, -1 keeps the controller, -2 selects the sender, and -3 releases the sender's control.
        """
        self.primary = _new_controller(self.primary, sender, p[0], p[1])
        self.secondary = _new_controller(self.secondary, sender, p[2], p[3])

    def controlled_by(self, sender: Controller) -> bool:
        """Return whether ``sender`` has primary control."""
        return sender == self.primary and sender != NO_CONTROLLER


def _new_controller(present: Controller, sender: Controller, system: float, component: float) -> Controller:
    """Return the controller after a request from ``sender``."""
    ids = [round(value) if math.isfinite(value) else -1 for value in (system, component)]
    if ids[0] == _RELEASE:
        return NO_CONTROLLER if present == sender else present
    if ids[0] == _SENDER:
        return sender
    if ids[0] in _UNCHANGED or not all(0 <= number <= _MAX_ID for number in ids):
        return present
    return ids[0], ids[1]
