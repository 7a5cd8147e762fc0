"""Conditions for running motors: arming, kill switch, lockdown, termination (PX4's ``actuator_armed``), motor tests."""

from __future__ import annotations

import enum
import math

import numpy as np

from xtdrone_autopilot.state import MAX_ROTORS, MotorTest
from xtdrone_autopilot.vehicle_view import VehicleView

_LONGEST_TEST_MS = 3000


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
    """Motor stops that leave the vehicle armed, and motor tests of the disarmed vehicle.

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
        if armed or self.stopped:
            self._view.end_motor_test()
        if not armed or not (self.killed or self.locked):
            self._since_us = None
        elif self._since_us is None:
            self._since_us = self._view.time_us

    def test(self, motor: int, value: float, seconds: float) -> None:
        """Run a motor of the disarmed vehicle, as PX4 v1.14's ``ActuatorTest`` does; others under test keep running.

        Args:
            motor: number of the motor, from 0; one that the vehicle does not have is ignored.
            value: command, 0..1; above 1 counts as 1, below 0 or NaN stops the motor.
            seconds: time until all motors stop, at most 3 s; 0 or less, or NaN, releases this motor at once.
        """
        if self.stopped or not 0 <= motor < self._view.rotor_count:
            return
        running = self._view.motor_test
        outputs = np.full(MAX_ROTORS, math.nan) if running is None else running.outputs
        span_ms = 0 if math.isnan(seconds) else math.floor(min(max(1000.0 * seconds, 0.0), _LONGEST_TEST_MS) + 0.5)
        outputs[motor] = min(value, 1.0) if span_ms > 0 and value >= 0.0 else math.nan
        if np.isnan(outputs).all():
            self._view.end_motor_test()
        elif span_ms > 0:
            self._view.start_motor_test(MotorTest(outputs, self._view.time_us + 1000 * span_ms))

    def disarming(self, delay: float) -> ArmReason | None:
        """Return the reason to disarm after ``delay`` seconds of kill or lockdown, else None.

        A delay of 0 or less disables disarming.
        """
        if self._since_us is None or delay <= 0.0 or self._view.time_us - self._since_us < delay * 1e6:
            return None
        return ArmReason.KILLED if self.killed else ArmReason.LOCKDOWN
