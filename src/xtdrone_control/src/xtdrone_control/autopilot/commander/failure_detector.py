"""Failures that are seen from the vehicle's own measurements (PX4 v1.14's FailureDetector): attitude limit, motors."""

from __future__ import annotations

import math
from collections.abc import Callable

from xtdrone_control import rotation
from xtdrone_control.autopilot.vehicle_view import VehicleView

Get = Callable[[str], float]

_SMALL_TILT = 20.0  # deg; below it there is no need to look at roll and pitch, unless the limits are so narrow
_COS_SMALL_TILT = math.cos(math.radians(_SMALL_TILT))
_LARGEST = 180.0  # deg: 0 for a limit means none


class _Hysteresis:
    """True when a condition has held for a while, false as soon as it does not."""

    def __init__(self) -> None:
        self._since_us: int | None = None

    def update(self, holds: bool, now_us: int, delay_us: float) -> bool:
        if not holds:
            self._since_us = None
            return False
        if self._since_us is None:
            self._since_us = now_us
        return now_us - self._since_us >= delay_us


class FailureDetector:
    """Watches one vehicle; call ``update`` at 10 Hz.

    Attributes:
        roll: roll has been beyond FD_FAIL_R for FD_FAIL_R_TTRI.
        pitch: likewise pitch.
        motors: numbers, from 0, of the motors that were seen to stand still in this flight.
    """

    def __init__(self, view: VehicleView, get: Get) -> None:
        """Watch ``view``; ``get`` returns a parameter by name."""
        self._get = get
        # views of the record fields, which are read at every update
        self._q = view.estimator["q"]
        self._failed_rotors = view.setpoint_fields["failed_rotors"]
        self._currents, self._commands = view.sensors["esc_current"], view.control["actuators"]
        self._roll, self._pitch = _Hysteresis(), _Hysteresis()
        self._starved: dict[int, int] = {}  # motor -> when its current was first too low
        self._measured: set[int] = set()
        self.roll = self.pitch = False
        self.motors: tuple[int, ...] = ()

    @property
    def attitude(self) -> bool:
        """Whether roll or pitch is beyond its limit."""
        return self.roll or self.pitch

    def update(self, now_us: int, attitude_control: bool, armed: bool) -> None:
        """Look.

        Args:
            now_us: simulated time, microseconds.
            attitude_control: the mode controls the attitude; where it does not, every attitude is meant.
            armed: whether motors run.
        """
        if attitude_control:
            self._look_at_attitude(now_us)
        else:
            self.roll = self.pitch = False
        if not armed:
            self._starved.clear()
            self.motors = ()
        elif int(self._get("FD_ACT_EN")):
            self._look_at_motors(now_us)
        # as PX4: the allocator does without one motor, and goes on with it if more seem to be gone
        leaves_out = len(self.motors) == 1 and int(self._get("CA_FAILURE_MODE"))
        self._failed_rotors[0] = 1 << self.motors[0] if leaves_out else 0

    def _look_at_attitude(self, now_us: int) -> None:
        get = self._get
        w, x, y, z = self._q.tolist()
        least = min(get("FD_FAIL_R") or _LARGEST, get("FD_FAIL_P") or _LARGEST)
        if least > _SMALL_TILT and 1.0 - 2.0 * (x * x + y * y) > _COS_SMALL_TILT:
            # the tilt is never less than roll or pitch
            self.roll = self._roll.update(False, now_us, 0.0)
            self.pitch = self._pitch.update(False, now_us, 0.0)
            return
        roll, pitch, _ = map(abs, rotation.to_euler((w, x, y, z)))
        limits = math.radians(get("FD_FAIL_R")), math.radians(get("FD_FAIL_P"))
        self.roll = self._roll.update(0.0 < limits[0] < roll, now_us, get("FD_FAIL_R_TTRI") * 1e6)
        self.pitch = self._pitch.update(0.0 < limits[1] < pitch, now_us, get("FD_FAIL_P_TTRI") * 1e6)

    def _look_at_motors(self, now_us: int) -> None:
        """Find motors that take less current than their command lets expect for FD_ACT_MOT_TOUT."""
        get = self._get
        least, slope = get("FD_ACT_MOT_THR"), get("FD_ACT_MOT_C2T")
        timeout_us = get("FD_ACT_MOT_TOUT") * 1e3
        currents = self._currents.tolist()
        for motor, command in enumerate(self._commands.tolist()):
            current = currents[motor]
            if current > 0.0:
                self._measured.add(motor)
            if motor not in self._measured or command <= least or current >= slope * command:
                self._starved.pop(motor, None)
                continue
            since_us = self._starved.setdefault(motor, now_us)
            if now_us - since_us >= timeout_us and motor not in self.motors:
                self.motors = (*self.motors, motor)
