"""An autopilot without kernels, for tests of the code above its records."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.parameters.parameters import PARAMS, Parameters
from xtdrone_autopilot.state import CONTROL, ESTIMATOR, FAILURES, SENSORS, SETPOINT, TASK_GOTO, records
from xtdrone_common.fleet import Vehicle

ORIGIN = (47.397742, 8.545594, 488.0)  # degrees, m AMSL
FIRST_ID = 170  # far from the ports of a running simulation


class FakeAutopilot:
    """Records in the state in which the kernels keep them: ready on the ground, with a good estimate."""

    def __init__(self, count: int = 1) -> None:
        self.count = count
        self.logs: list[Any] = []
        self.motor_tests: dict[int, Any] = {}
        self.time_us = 1_000_000
        self.sensors = records(SENSORS, count)
        self.estimator = records(ESTIMATOR, count)
        self.setpoint = records(SETPOINT, count)
        self.control = records(CONTROL, count)
        self.failures = records(FAILURES, count)
        self.params = records(PARAMS, count)
        self.rotors = np.full(count, 4)
        self.estimator["q"][:, 0] = 1.0
        self.control["sp_q"][:, 0] = 1.0
        self.control["landing"]["landed"] = 1
        for field in ("initialised", "attitude_valid", "velocity_valid", "position_valid", "altitude_valid"):
            self.estimator[field] = 1
        for field in ("global_valid", "heading_good", "gps_good", "baro_good", "mag_good", "located"):
            self.estimator[field] = 1
        for field in ("heading_aligned", "mag_used", "gps_used"):
            self.estimator[field] = 1
        self.estimator["flags"] = 831  # as PX4 on the ground with GPS
        for field, value in zip(("set", "lat", "lon", "alt"), (1, *ORIGIN), strict=True):
            self.estimator["origin"][field] = value
        self.sensors["gps_fix"] = 3
        self.sensors["battery_voltage"] = 16.2
        self.sensors["battery_current"] = -1.0

    def rotor_count(self, _index: int) -> int:
        return 4

    def end_motor_test(self, index: int) -> None:
        self.motor_tests.pop(index, None)

    def place(self, index: int, x: float, y: float, z: float, yaw: float = 0.0) -> None:
        """Set a vehicle's position (m, NED); it is in the air above 0.1 m."""
        self.estimator[index]["position"] = (x, y, z)
        self.estimator[index]["q"] = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        self.control[index]["landing"]["landed"] = int(z > -0.1)


class Flight:
    """One vehicle whose motion is its goal, reached at once when ``follow`` is called."""

    def __init__(self, **parameters: float) -> None:
        self.autopilot: Any = FakeAutopilot()
        self.parameters = Parameters({"MAV_SYS_ID": 1})
        for name, value in parameters.items():
            self.parameters.set(name, value)
        self.commander = Commander(Vehicle("iris", 0, FIRST_ID), self.autopilot, self.parameters, 0)
        self.setpoint = self.autopilot.setpoint[0]
        self.commander.update()

    def run(self, seconds: float, each: Any = None) -> None:
        """Advance time by updates at 10 Hz, and call ``each`` before every update."""
        for _ in range(round(seconds * 10)):
            self.autopilot.time_us += 100_000
            if each is not None:
                each()
            self.commander.update()

    def follow(self) -> None:
        """Move the vehicle to the position of TASK_GOTO."""
        if self.setpoint["task"] == TASK_GOTO:
            self.place(*self.setpoint["goal_position"].tolist())

    def place(self, x: float, y: float, z: float, yaw: float = 0.0) -> None:
        """Set the vehicle's position; an armed vehicle that leaves the ground takes off where it stood, as its home."""
        landing = self.autopilot.control[0]["landing"]
        if self.commander.armed and landing["landed"] and z <= -0.1:
            landing["landed"] = 0
            self.commander.update()
        self.autopilot.place(0, x, y, z, yaw)

    def hover(self) -> None:
        """Return a position setpoint of the OFFBOARD stream."""
        nan = (math.nan,) * 3
        self.commander.offboard.set_trajectory((1.0, 2.0, -3.0), nan, nan, 0.0, math.nan)

    def texts(self) -> list[str]:
        """Return the queued texts, without the tab that marks an additional event."""
        found = [text.rstrip("\t") for _, text in self.commander.texts]
        self.commander.texts.clear()
        return found
