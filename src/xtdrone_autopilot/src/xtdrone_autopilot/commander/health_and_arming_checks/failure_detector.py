"""Detection of attitude and motor failures, modelled on PX4 v1.14's ``FailureDetector``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from xtdrone_autopilot.vehicle_view import VehicleView
from xtdrone_common import rotation

Get = Callable[[str], float]

_SMALL_TILT = 20.0  # deg; a smaller tilt needs no check of roll and pitch, unless a limit is below it
_COS_SMALL_TILT = math.cos(math.radians(_SMALL_TILT))
_NO_LIMIT = 180.0  # deg, replaces a limit of 0, which disables the check


class _Hysteresis:
    """Condition that becomes true after a delay and false immediately."""

    def __init__(self) -> None:
        self._since_us: int | None = None

    def update(self, holds: bool, now_us: int, delay_us: float) -> bool:
        if not holds:
            self._since_us = None
            return False
        if self._since_us is None:
            self._since_us = now_us
        return now_us - self._since_us >= delay_us


def _motors_below(currents: Sequence[float], commands: Sequence[float], min_command: float, slope: float) -> list[int]:
    """Return the motors with a command above ``min_command`` whose current, A, is below ``slope`` times the command."""
    return [
        motor
        for motor, (current, command) in enumerate(zip(currents, commands, strict=True))
        if not (command <= min_command or current >= slope * command)
    ]


class FailureDetector:
    """Failure detector of one vehicle.

    Attributes:
        roll: whether roll has exceeded FD_FAIL_R for FD_FAIL_R_TTRI.
        pitch: whether pitch has exceeded FD_FAIL_P for FD_FAIL_P_TTRI.
        motors: indices of the motors that have failed since arming.
    """

    def __init__(self, view: VehicleView, get: Get) -> None:
        """Start without failures.

        Args:
            view: access to the vehicle's autopilot records.
            get: returns a parameter by name.
        """
        self._get = get
        # views of the record fields, cached because every update reads them
        self._q = view.estimator["q"]
        self._failed_rotors = view.cell("setpoint", "failed_rotors")
        self._rotors = view.rotor_count
        self._currents = view.sensors["esc_current"][: self._rotors]
        self._commands = view.control["actuators"][: self._rotors]
        self._roll, self._pitch = _Hysteresis(), _Hysteresis()
        self._low_current_us: dict[int, int] = {}  # motor index to the time since which its current has been too low
        self._measured: set[int] = set()
        self.roll = self.pitch = False
        self.motors: tuple[int, ...] = ()

    @property
    def attitude(self) -> bool:
        """Whether roll or pitch has exceeded its limit."""
        return self.roll or self.pitch

    def update(self, now_us: int, attitude_control: bool, armed: bool) -> None:
        """Check attitude and motors; call at 10 Hz.

        Args:
            now_us: simulated time, microseconds.
            attitude_control: whether the mode controls the attitude; without it any attitude is valid.
            armed: whether the vehicle is armed.
        """
        if attitude_control:
            self._check_attitude(now_us)
        else:
            self.roll = self.pitch = False
        if not armed:
            self._low_current_us.clear()
            self.motors = ()
        elif int(self._get("FD_ACT_EN")):
            self._check_motors(now_us)
        # as in PX4, the allocator excludes a single failed motor but none if several seem to have failed
        leaves_out = len(self.motors) == 1 and int(self._get("CA_FAILURE_MODE"))
        self._failed_rotors[0] = 1 << self.motors[0] if leaves_out else 0

    def _check_attitude(self, now_us: int) -> None:
        get = self._get
        w, x, y, z = self._q.tolist()
        min_limit = min(get("FD_FAIL_R") or _NO_LIMIT, get("FD_FAIL_P") or _NO_LIMIT)
        if min_limit > _SMALL_TILT and 1.0 - 2.0 * (x * x + y * y) > _COS_SMALL_TILT:
            # roll and pitch never exceed the tilt
            self.roll = self._roll.update(False, now_us, 0.0)
            self.pitch = self._pitch.update(False, now_us, 0.0)
            return
        roll, pitch, _ = map(abs, rotation.to_euler((w, x, y, z)))
        limits = math.radians(get("FD_FAIL_R")), math.radians(get("FD_FAIL_P"))
        self.roll = self._roll.update(0.0 < limits[0] < roll, now_us, get("FD_FAIL_R_TTRI") * 1e6)
        self.pitch = self._pitch.update(0.0 < limits[1] < pitch, now_us, get("FD_FAIL_P_TTRI") * 1e6)

    def _check_motors(self, now_us: int) -> None:
        """Detect motors that draw less current than expected from their command for FD_ACT_MOT_TOUT."""
        get = self._get
        min_command, slope = get("FD_ACT_MOT_THR"), get("FD_ACT_MOT_C2T")
        timeout_us = get("FD_ACT_MOT_TOUT") * 1e3
        currents, commands = self._currents.tolist(), self._commands.tolist()
        if len(self._measured) < self._rotors:
            self._measured.update([motor for motor, current in enumerate(currents) if current > 0.0])
        all_draw_enough = slope >= 0.0 and min(currents) >= slope * max(commands)
        low = [] if all_draw_enough else _motors_below(currents, commands, min_command, slope)
        if not (low or self._low_current_us):
            return
        before = self._low_current_us
        self._low_current_us = {motor: before.get(motor, now_us) for motor in low if motor in self._measured}
        for motor, since_us in self._low_current_us.items():
            if now_us - since_us >= timeout_us and motor not in self.motors:
                self.motors = (*self.motors, motor)
