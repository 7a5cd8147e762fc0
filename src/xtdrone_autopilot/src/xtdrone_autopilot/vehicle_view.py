"""Access to one vehicle's records for commander, navigator and telemetry, and changes of the local frame's origin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from xtdrone_autopilot.state import HEIGHT_RANGE, HEIGHT_VISION, SETPOINT, MotorTest
from xtdrone_common import rotation
from xtdrone_common.geodesy import projection

if TYPE_CHECKING:
    from .autopilot import Autopilot

Vector = tuple[float, float, float]

_OFFSETS = {name: field[1] for name, field in (SETPOINT.fields or {}).items()}
_TRAJECTORY = slice(_OFFSETS["position"], _OFFSETS["attitude_q"])  # bytes of SETPOINT


def cell(records: np.ndarray, index: int, *names: str) -> memoryview:
    """Return a view of one scalar field of the record ``index``, whose only element is read and written by ``[0]``.

    This is several times faster than the access to a field of the record. ``names`` is the field, or the path to it in
    nested records.
    """
    for name in names:
        records = records[name]
    view: memoryview = records[index : index + 1].data
    return view


class VehicleView:
    """View of one vehicle's records in an ``Autopilot``; writes change the records.

    Attributes:
        sensors, estimator, setpoint, control, failures: the vehicle's elements of the record arrays.
        setpoint_fields: name of a setpoint field to an array over it, for frequent writes; ``trajectory`` is position,
            velocity, acceleration, yaw and yaw rate in one.
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
        self._landed = cell(autopilot.control, index, "landing", "landed")
        self._initialised = cell(autopilot.estimator, index, "initialised")
        self._horizontal_valid = cell(autopilot.estimator, index, "position_valid")
        self._height_valid = cell(autopilot.estimator, index, "altitude_valid")
        self._origin_set = cell(autopilot.estimator, index, "origin", "set")
        self._task = cell(autopilot.setpoint, index, "task")
        self._task_changed = cell(autopilot.setpoint, index, "task_changed")
        self._position, self._velocity = self.estimator["position"], self.estimator["velocity"]
        element = autopilot.setpoint[index : index + 1]
        self.setpoint_fields = {name: element[name].reshape(-1) for name in SETPOINT.names or ()}
        self.setpoint_fields["trajectory"] = element.view(np.uint8)[_TRAJECTORY].view(np.float64)
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
        return bool(self._landed[0])

    @property
    def initialised(self) -> bool:
        """Whether the estimator has an attitude."""
        return bool(self._initialised[0])

    @property
    def position_valid(self) -> bool:
        """Whether horizontal position and height are valid."""
        return self.horizontal_valid and self.height_valid

    @property
    def horizontal_valid(self) -> bool:
        """Whether the horizontal position is valid."""
        return bool(self._horizontal_valid[0])

    @property
    def height_valid(self) -> bool:
        """Whether the height is valid."""
        return bool(self._height_valid[0])

    def cell(self, record: str, *names: str) -> memoryview:
        """Return a view of one scalar of the vehicle's ``record`` ("sensors", "control", ...); see ``cell``."""
        return cell(getattr(self._autopilot, record), self._index, *names)

    @property
    def has_origin(self) -> bool:
        """Whether the local frame has an origin, which ``to_local`` and ``to_global`` require."""
        return bool(self._origin_set[0])

    @property
    def global_valid(self) -> bool:
        """Whether global position and height are valid."""
        return bool(self.estimator["global_valid"]) and self.height_valid

    @property
    def position(self) -> Vector:
        """Estimated position, m, local NED."""
        x, y, z = self._position.tolist()
        return x, y, z

    @property
    def velocity(self) -> Vector:
        """Estimated velocity, m/s, local NED."""
        x, y, z = self._velocity.tolist()
        return x, y, z

    @property
    def yaw(self) -> float:
        """Estimated heading, rad, clockwise from north, -pi..pi."""
        return rotation.yaw_of(self.estimator["q"].tolist())

    @property
    def origin(self) -> Vector:
        """Origin of the local frame: latitude and longitude in degrees, altitude in m AMSL."""
        origin = self.estimator["origin"]
        return float(origin["lat"]), float(origin["lon"]), float(origin["alt"])

    def to_local(self, latitude: float, longitude: float, altitude: float) -> Vector:
        """Return the local position (m, NED) of a global one in degrees and m AMSL."""
        origin_lat, origin_lon, origin_alt = self.origin
        north, east = projection.project(latitude, longitude, origin_lat, origin_lon)
        return north, east, origin_alt - altitude

    def to_global(self, position: Vector) -> Vector:
        """Return (latitude, longitude, altitude), in degrees and m AMSL, of a local position (m, NED)."""
        origin_lat, origin_lon, origin_alt = self.origin
        latitude, longitude = projection.reproject(position[0], position[1], origin_lat, origin_lon)
        return latitude, longitude, origin_alt - position[2]

    @property
    def task(self) -> int:
        """The current flight task (``state.TASK_*``)."""
        return int(self._task[0])

    def start_task(self, task: int) -> None:
        """Start the flight task ``task`` (``state.TASK_*``)."""
        self._task[0] = task
        self._task_changed[0] = 1


_LOWEST, _HIGHEST = -12_000.0, 100_000.0  # m AMSL: a deep-sea trench, the edge of space


def is_origin(latitude: float, longitude: float, altitude: float) -> bool:
    """Return whether a position (degrees, m AMSL) is valid as an origin."""
    return abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and _LOWEST < altitude < _HIGHEST


def move_origin(e: Any, latitude: float, longitude: float, altitude: float) -> None:
    """Set the origin of an ``ESTIMATOR`` record, as PX4 v1.14's Ekf::setEkfGlobalOrigin.

    With a valid global position, that position stays and the local position is reset to match the new origin. Without
    one, the local position stays and the origin defines the global position.

    Args:
        e: ``ESTIMATOR`` record.
        latitude: degrees.
        longitude: degrees.
        altitude: m AMSL.

    Raises:
        ValueError: the position is not valid as an origin.
    """
    if not is_origin(latitude, longitude, altitude):
        raise ValueError(f"origin: {latitude}, {longitude}, {altitude} m is not a position on Earth")
    origin = e["origin"]
    if origin["set"] and e["position_valid"]:
        x, y, _ = e["position"].tolist()
        vehicle = projection.reproject(x, y, float(origin["lat"]), float(origin["lon"]))
        north, east = projection.project(*vehicle, latitude, longitude)
        _shift(e, north - x, east - y, altitude - float(origin["alt"]))
    origin["lat"], origin["lon"], origin["alt"] = latitude, longitude, altitude
    origin["set"] = 1
    e["global_valid"] = int(e["position_valid"]) & int(e["heading_aligned"])


def _shift(e: Any, north: float, east: float, down: float) -> None:
    e["position"] += (north, east, down)
    e["last_position"] += (north, east)
    e["vision_offset"] -= (north, east)
    for source in (HEIGHT_RANGE, HEIGHT_VISION):  # barometer and GPS measure AMSL and need no correction
        e["height_offset"][source] += down
    e["terrain"] += down
    e["shifts"]["xy"] = (north, east)
    e["shifts"]["z"] = down
    for counter, count in (("xy", 1), ("z", 1), ("any", 2)):
        e["resets"][counter] += count
