"""Access to one vehicle's records for commander, navigator and telemetry."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from xtdrone_control import rotation
from xtdrone_control.geodesy import geo

from .state import SETPOINT, MotorTest

if TYPE_CHECKING:
    from .autopilot import Autopilot

Vector = tuple[float, float, float]


class VehicleView:
    """View of one vehicle's records in an ``Autopilot``; writes change the records.

    Attributes:
        sensors, estimator, setpoint, control, failures: the vehicle's elements of the record arrays.
        setpoint_fields: name of a setpoint field to an array over it, for frequent writes.
    """

    def __init__(self, autopilot: Autopilot, index: int) -> None:
        """View vehicle ``index`` of ``autopilot``."""
        self._autopilot = autopilot
        self._index = index
        self.sensors: Any = autopilot.sensors[index]
        self.estimator: Any = autopilot.estimator[index]
        self.setpoint: Any = autopilot.setpoint[index]
        self.control: Any = autopilot.control[index]
        self.failures: Any = autopilot.failures[index]
        element = autopilot.setpoint[index : index + 1]
        self.setpoint_fields = {name: element[name].reshape(-1) for name in SETPOINT.names or ()}
        assert all(np.shares_memory(field, element) for field in self.setpoint_fields.values())

    @property
    def time_us(self) -> int:
        """Simulated time, microseconds."""
        return self._autopilot.time_us

    @property
    def motor_test(self) -> MotorTest | None:
        """The motor test that is running."""
        return self._autopilot.motor_tests.get(self._index)

    def start_motor_test(self, test: MotorTest) -> None:
        """Run motors of the disarmed vehicle, in place of the test that is running."""
        self._autopilot.motor_tests[self._index] = test

    def end_motor_test(self) -> None:
        """Stop the motors that run for a test."""
        self._autopilot.end_motor_test(self._index)

    @property
    def rotor_count(self) -> int:
        """Number of rotors."""
        return self._autopilot.rotor_count(self._index)

    @property
    def landed(self) -> bool:
        """Whether the land detector reports landed."""
        return bool(self.control["landing"]["landed"])

    @property
    def initialised(self) -> bool:
        """Whether the estimator has an attitude."""
        return bool(self.estimator["initialised"])

    @property
    def position_valid(self) -> bool:
        """Whether horizontal position and height are valid."""
        return bool(self.estimator["position_valid"]) and bool(self.estimator["altitude_valid"])

    @property
    def has_origin(self) -> bool:
        """Whether the local frame has an origin, which ``to_local`` and ``to_global`` require."""
        return bool(self.estimator["origin_set"])

    @property
    def global_valid(self) -> bool:
        """Whether global position and height are valid."""
        return bool(self.estimator["global_valid"]) and bool(self.estimator["altitude_valid"])

    @property
    def position(self) -> Vector:
        """Estimated position, m, local NED."""
        x, y, z = self.estimator["position"].tolist()
        return x, y, z

    @property
    def velocity(self) -> Vector:
        """Estimated velocity, m/s, local NED."""
        x, y, z = self.estimator["velocity"].tolist()
        return x, y, z

    @property
    def yaw(self) -> float:
        """Estimated heading, rad, clockwise from north, -pi..pi."""
        return rotation.yaw_of(self.estimator["q"].tolist())

    @property
    def origin(self) -> Vector:
        """Origin of the local frame: latitude and longitude in degrees, altitude in m AMSL."""
        e = self.estimator
        return float(e["origin_lat"]), float(e["origin_lon"]), float(e["origin_alt"])

    def to_local(self, latitude: float, longitude: float, altitude: float) -> Vector:
        """Return the local position (m, NED) of a global one in degrees and m AMSL."""
        origin_lat, origin_lon, origin_alt = self.origin
        north, east = geo.project(latitude, longitude, origin_lat, origin_lon)
        return north, east, origin_alt - altitude

    def to_global(self, position: Vector) -> Vector:
        """Return (latitude, longitude, altitude), in degrees and m AMSL, of a local position (m, NED)."""
        origin_lat, origin_lon, origin_alt = self.origin
        latitude, longitude = geo.reproject(position[0], position[1], origin_lat, origin_lon)
        return latitude, longitude, origin_alt - position[2]

    def start_task(self, task: int) -> None:
        """Start the flight task ``task`` (``state.TASK_*``)."""
        self.setpoint["task"] = task
        self.setpoint["task_changed"] = 1
