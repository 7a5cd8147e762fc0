"""Whether a vehicle's motors may run: arming, kill switch, lockdown, termination (PX4's ``actuator_armed``)."""

from __future__ import annotations

import enum

from xtdrone_control.autopilot.vehicle_view import VehicleView


class ArmReason(enum.Enum):
    """Why a vehicle is armed or disarmed: PX4's number (arm_disarm_reason_t) and its words."""

    STICK = (1, "RC")
    SWITCH = (2, "RC (switch)")
    COMMAND = (4, "external command")
    MISSION = (5, "mission start")
    LANDING = (6, "landing")
    UNUSED = (7, "auto preflight disarming")
    KILLED = (8, "kill switch")
    LOCKDOWN = (9, "lockdown")
    BUTTON = (13, "RC (button)")
    FAILSAFE = (14, "failsafe")


class MotorSwitch:
    """What stops an armed vehicle's motors; it stays armed.

    Attributes:
        killed: by a kill switch.
        locked: by MAV_CMD_DO_FLIGHTTERMINATION's test.
        terminated: the flight has been ended for good.
    """

    def __init__(self, view: VehicleView) -> None:
        """Start with nothing that stops the motors of ``view``."""
        self._view = view
        self._since_us: int | None = None
        self.killed = self.locked = self.terminated = False

    @property
    def stopped(self) -> bool:
        """Whether something stops the motors."""
        return self.killed or self.locked or self.terminated

    def apply(self, armed: bool) -> None:
        """Let the motors of an armed vehicle run, unless something stops them; call it when any of this changes."""
        self._view.setpoint["armed"] = int(armed and not self.stopped)
        if not armed or not (self.killed or self.locked):
            self._since_us = None
        elif self._since_us is None:
            self._since_us = self._view.time_us

    def disarming(self, delay: float) -> ArmReason | None:
        """Return why the vehicle is to be disarmed: killed or locked for ``delay`` seconds (0 or less: never)."""
        if self._since_us is None or delay <= 0.0 or self._view.time_us - self._since_us < delay * 1e6:
            return None
        return ArmReason.KILLED if self.killed else ArmReason.LOCKDOWN
