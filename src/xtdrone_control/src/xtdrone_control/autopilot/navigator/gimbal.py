"""Where a gimbal is told to look, and who may say so: PX4's gimbal manager (MAVLink's gimbal protocol v2).

https://mavlink.io/en/services/gimbal_v2.html. Angles are roll, pitch, yaw in rad: roll and pitch from the horizon,
pitch positive up, yaw from the heading. The gimbal keeps roll and pitch level by itself, so the protocol's locks of
those two axes hold always; yaw follows the vehicle unless it is locked, then it keeps its direction over the ground.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from xtdrone_control.autopilot.vehicle_view import Vector, VehicleView

Controller = tuple[int, int]
"""MAVLink system and component id; (0, 0) for nobody."""

NOBODY: Controller = (0, 0)
RETRACT, NEUTRAL, ROLL_LOCK, PITCH_LOCK, YAW_LOCK = 1, 2, 4, 8, 16  # GIMBAL_MANAGER_FLAGS
YAW_IN_VEHICLE_FRAME, YAW_IN_EARTH_FRAME = 32, 64
_LOCKED = YAW_LOCK | YAW_IN_EARTH_FRAME

_LEVEL: Vector = (0.0, 0.0, 0.0)
_UNTOLD: Vector = (math.nan, math.nan, math.nan)
_STEEPEST = 0.5 * math.pi  # rad, of a pitch that is turned at a rate
_MODE_RETRACT, _MODE_NEUTRAL, _MODE_ANGLES, _MODE_PLACE = 0, 1, 2, 4  # MAV_MOUNT_MODE
_UNCHANGED, _MYSELF, _GIVE_BACK = (0, -1), -2, -3  # of DO_GIMBAL_MANAGER_CONFIGURE
_LARGEST_ID = 255


class GimbalManager:
    """The setpoint of one vehicle's gimbal.

    Attributes:
        primary, secondary: who may steer it by the protocol's second version. Missions and DO_MOUNT_CONTROL, which
            know no such thing, always may.
        flags: GIMBAL_MANAGER_FLAGS that hold.
    """

    def __init__(self, view: VehicleView) -> None:
        """Start with nothing told."""
        self._view = view
        self.primary = self.secondary = NOBODY
        self.flags = ROLL_LOCK | PITCH_LOCK
        self._angles = _UNTOLD
        self._rates = (0.0, 0.0)  # of pitch and yaw, rad/s
        self._since_us = 0
        self._place: Vector | None = None  # to look at, m, local NED

    @property
    def angles(self) -> Vector:
        """The setpoint as it is now; NaN while nothing has been told."""
        if self._place is not None:
            return self._towards(self._place)
        roll, pitch, yaw = self._turned()
        if self.flags & YAW_LOCK:
            yaw -= self._view.yaw
        return roll, pitch, math.remainder(yaw, 2.0 * math.pi)

    def _turned(self) -> Vector:
        """Return the angles that were told, as far as the rates have brought them; yaw from north when it is locked."""
        roll, pitch, yaw = self._angles
        seconds = (self._view.time_us - self._since_us) * 1e-6
        pitch_rate, yaw_rate = self._rates
        if pitch_rate != 0.0:
            pitch = min(max(pitch + pitch_rate * seconds, -_STEEPEST), _STEEPEST)
        return roll, pitch, yaw + yaw_rate * seconds

    def _towards(self, place: Vector) -> Vector:
        north, east, down = (a - b for a, b in zip(place, self._view.position, strict=True))
        bearing = math.atan2(east, north)
        return 0.0, math.atan2(-down, math.hypot(north, east)), math.remainder(bearing - self._view.yaw, 2.0 * math.pi)

    # what it is told

    def look(self, angles: Vector, flags: int = 0, rates: tuple[float, float] = (0.0, 0.0)) -> None:
        """Take a setpoint.

        Args:
            angles: roll, pitch, yaw, rad; yaw from north with YAW_LOCK. Not finite: as it is now.
            flags: GIMBAL_MANAGER_FLAGS.
            rates: of pitch and yaw, rad/s, from ``angles`` on; not finite for none.
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
        self._place = None

    def look_at(self, place: Vector | None) -> None:
        """Look at a place (m, local NED) from now on; None: look where it does now, from the vehicle."""
        if place is None:
            if self._place is not None:
                self.look(self.angles)
        elif all(map(math.isfinite, place)):
            self._place = place

    def mount(self, p: Sequence[float]) -> bool:
        """Take DO_MOUNT_CONTROL's seven parameters, all finite; say whether its mode is one that is known."""
        mode = round(p[6])
        if mode in (_MODE_RETRACT, _MODE_NEUTRAL):
            self.look(_LEVEL, NEUTRAL)
        elif mode == _MODE_ANGLES:
            self.look((math.radians(p[1]), math.radians(p[0]), math.radians(p[2])))
        elif mode == _MODE_PLACE:
            self.look_at(self._view.to_local(p[4], p[5], p[3]))
        else:
            return False
        return True

    def pitch_yaw(self, p: Sequence[float]) -> None:
        """Take DO_GIMBAL_MANAGER_PITCHYAW's parameters: degrees, degrees/s, flags; NaN where they are not given."""
        pitch, yaw, pitch_rate, yaw_rate = (math.radians(value) for value in p[:4])
        flags = int(p[4]) if math.isfinite(p[4]) and 0.0 <= p[4] < 1 << 31 else 0
        self.look((0.0, pitch, yaw), flags, (pitch_rate, yaw_rate))

    # who may tell it

    def configure(self, sender: Controller, p: Sequence[float]) -> None:
        """Obey DO_GIMBAL_MANAGER_CONFIGURE: who has primary and who has secondary control.

        Args:
            sender: who asks.
            p: its parameters: system and component of the primary, then of the secondary controller; -1 leaves one as
                it is, -2 is the sender, -3 takes it from the sender if he has it.
        """
        self.primary = _chosen(self.primary, sender, p[0], p[1])
        self.secondary = _chosen(self.secondary, sender, p[2], p[3])

    def controlled_by(self, sender: Controller) -> bool:
        """Return whether ``sender`` has primary control."""
        return sender == self.primary and sender != NOBODY


def _chosen(present: Controller, sender: Controller, system: float, component: float) -> Controller:
    """Return who is in control after a request."""
    ids = [round(value) if math.isfinite(value) else -1 for value in (system, component)]
    if ids[0] == _GIVE_BACK:
        return NOBODY if present == sender else present
    if ids[0] == _MYSELF:
        return sender
    if ids[0] in _UNCHANGED or not all(0 <= number <= _LARGEST_ID for number in ids):
        return present
    return ids[0], ids[1]
