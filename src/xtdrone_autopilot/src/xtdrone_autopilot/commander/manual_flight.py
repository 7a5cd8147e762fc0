"""Manual flight: stick input for the control cascade in manual modes."""

from __future__ import annotations

import math
from collections.abc import Callable

from xtdrone_autopilot.commander.manual_control import CENTRED, Sticks
from xtdrone_autopilot.state import TASK_ACRO, TASK_ALTITUDE, TASK_DESCEND, TASK_MANUAL, TASK_STICKS, TASK_TRAJECTORY
from xtdrone_autopilot.vehicle_view import VehicleView
from xtdrone_common import modes
from xtdrone_common.modes import Mode

Get = Callable[[str], float]

_NAN = math.nan
_UNSET = (_NAN, _NAN, _NAN)
_TASKS = {
    modes.POSCTL: TASK_STICKS,
    modes.ALTCTL: TASK_ALTITUDE,
    modes.STABILIZED: TASK_MANUAL,
    modes.MANUAL: TASK_MANUAL,
    modes.ACRO: TASK_ACRO,
}
# modes in which the throttle stick commands thrust instead of climb rate
MANUAL_THRUST = (modes.STABILIZED, modes.MANUAL, modes.ACRO)


class ManualFlight:
    """Stick control of one vehicle."""

    def __init__(self, view: VehicleView, get: Get) -> None:
        """Prepare the stick control.

        Args:
            view: access to the vehicle's autopilot records.
            get: returns a parameter by name.
        """
        self._view = view
        self._get = get

    def steer(self, mode: Mode, sticks: Sticks | None, blind: bool, *, restart: bool = False) -> None:
        """Write the sticks to the control cascade, with centred sticks in place of missing ones.

        Without manual control in POSCTL or ALTCTL the vehicle stops and descends, because PX4's flight tasks fail then.

        Args:
            mode: manual mode.
            sticks: stick positions; None without manual control.
            blind: whether the horizontal position estimate is missing.
            restart: whether the mode has just started.
        """
        task = _TASKS[mode]
        if sticks is None and mode not in MANUAL_THRUST:
            self._descend(blind, restart)
            return
        self._write(sticks or CENTRED, mode)
        if restart or self._view.task != task:
            self._view.start_task(task)

    def _write(self, sticks: Sticks, mode: Mode) -> None:
        x, y, z, yaw = sticks
        if mode not in MANUAL_THRUST:
            get = self._get
            dead_zone, expo = get("MPC_HOLD_DZ"), get("MPC_XY_MAN_EXPO")
            if mode is modes.POSCTL:  # in ALTCTL the tilt is proportional to the stick
                x, y = _shaped(x, dead_zone, expo), _shaped(y, dead_zone, expo)
            z = _shaped(z, dead_zone, get("MPC_Z_MAN_EXPO"))
            yaw = _shaped(yaw, dead_zone, get("MPC_YAW_EXPO"))
        fields = self._view.setpoint_fields
        for name, value in (("stick_x", x), ("stick_y", y), ("stick_z", z), ("stick_yaw", yaw)):
            fields[name][0] = value

    def _descend(self, blind: bool, restart: bool) -> None:
        """Stop and descend at MPC_LAND_SPEED with constant heading; level if the horizontal estimate is missing."""
        setpoint = self._view.setpoint
        task = TASK_DESCEND if blind else TASK_TRAJECTORY
        if not restart and setpoint["task"] == task:
            return
        if not blind:
            setpoint["position"] = _UNSET
            setpoint["velocity"] = (0.0, 0.0, self._get("MPC_LAND_SPEED"))
            setpoint["acceleration"] = _UNSET
            setpoint["yaw"] = setpoint["yaw_rate"] = _NAN
        self._view.start_task(task)


def _shaped(value: float, dead_zone: float, expo: float) -> float:
    """Return a stick value (-1..1) after dead zone and exponential curve, linear (expo 0) to cubic (expo 1)."""
    value = min(max(value, -1.0), 1.0)
    size = abs(value) - dead_zone
    if size <= 0.0 or dead_zone >= 1.0:
        return 0.0
    size /= 1.0 - dead_zone
    return math.copysign((1.0 - expo) * size + expo * size**3, value)
