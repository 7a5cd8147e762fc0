"""Conditions under which the motors run: arming, kill switch, lockdown, termination (PX4's ``actuator_armed``)."""

from __future__ import annotations

import enum

from xtdrone_control.autopilot.vehicle_view import VehicleView


class ArmReason(enum.Enum):
    """Reason for arming or disarming: PX4's number (arm_disarm_reason_t) and text."""

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
    """Motor stops that leave the vehicle armed.

    Attributes:
        killed: stopped by the kill switch.
        locked: stopped by the test of MAV_CMD_DO_FLIGHTTERMINATION.
        terminated: stopped by flight termination.
    """

    def __init__(self, view: VehicleView) -> None:
        """Start without any stop; ``view`` gives access to the vehicle's autopilot records."""
        self._view = view
        self._since_us: int | None = None
        self.killed = self.locked = self.terminated = False

    @property
    def stopped(self) -> bool:
        """Whether any stop is active."""
        return self.killed or self.locked or self.terminated

    def apply(self, armed: bool) -> None:
        """Run the motors of an armed vehicle unless a stop is active; call after every change of either."""
        self._view.setpoint["armed"] = int(armed and not self.stopped)
        if not armed or not (self.killed or self.locked):
            self._since_us = None
        elif self._since_us is None:
            self._since_us = self._view.time_us

    def disarming(self, delay: float) -> ArmReason | None:
        """Return the reason to disarm after ``delay`` seconds of kill or lockdown, else None.

        A delay of 0 or less disables disarming.
        """
        if self._since_us is None or delay <= 0.0 or self._view.time_us - self._since_us < delay * 1e6:
            return None
        return ArmReason.KILLED if self.killed else ArmReason.LOCKDOWN
