"""State of one vehicle from which telemetry messages are built.

Local NED and body FRD, quaternions (w, x, y, z), as in MAVLink. Times are simulated; SYSTEM_TIME counts from a fixed
date, so that the same flight yields the same bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from xtdrone_native import mavlink_wire

from xtdrone_autopilot.commander.commander import Commander
from xtdrone_common.geodesy.projection import EARTH_RADIUS

if TYPE_CHECKING:
    from xtdrone_autopilot.autopilot import Autopilot

Values = tuple[Any, ...]
Content = Values | bytes
"""Field values of a message in wire order, or its payload."""

EPOCH_US = 1_577_836_800_000_000  # 2020-01-01 00:00 UTC, simulated time 0

# fields of the records that xtdrone_native.mavlink_wire reads
_ESTIMATOR_FIELDS = [
    "q",
    "position",
    "velocity",
    "rates",
    "P",
    "terrain",
    "initialised",
    "altitude_valid",
    "terrain_valid",
]
_SENSOR_FIELDS = ["accel", "gyro", "mag", "baro_pressure", "baro_alt", "baro_temperature"]
_CONTROL_FIELDS = [
    "sp_q",
    "sp_rates",
    "sp_thrust",
    "sp_position",
    "sp_velocity",
    "sp_acceleration",
    "sp_yaw",
    "sp_yaw_rate",
    "actuators",
]


def _records(autopilot: Autopilot, index: int) -> mavlink_wire.Telemetry:
    """Return the telemetry that is built from the records of vehicle ``index``."""
    own = slice(index, index + 1)
    estimator = autopilot.estimator[own]
    fields = {name: estimator[name] for name in _ESTIMATOR_FIELDS}
    fields |= {f"origin_{name}": estimator["origin"][name] for name in ("set", "lat", "lon", "alt")}
    fields["reset_counter"] = estimator["resets"]["any"]
    fields |= {name: autopilot.sensors[own][name] for name in _SENSOR_FIELDS}
    fields |= {name: autopilot.control[own][name] for name in _CONTROL_FIELDS}
    return mavlink_wire.Telemetry(fields, fields["P"].shape[1], EARTH_RADIUS)


def round_within(value: float, least: int, most: int) -> int:
    """Return ``value`` clamped to ``least``..``most`` and rounded."""
    return round(min(max(value, least), most))


class VehicleState:
    """Records of one vehicle, its commander, and the time of its telemetry.

    Attributes:
        commander: the vehicle's commander.
        sensors, estimator, setpoint, control: the vehicle's records.
        records: payloads of the messages with high rates, which ``xtdrone_native.mavlink_wire`` builds.
        rotor_count: number of rotors.
        variances: diagonal of the estimator's covariance, shape (N_STATES,).
        time_us: simulated time of the values, microseconds.
        time_ms: simulated time in milliseconds, the unit of most messages.
    """

    def __init__(self, commander: Commander, autopilot: Autopilot, index: int) -> None:
        """Read the records of vehicle ``index`` of ``autopilot``."""
        self.commander = commander
        self.sensors = autopilot.sensors[index]
        self.estimator = autopilot.estimator[index]
        self.setpoint = autopilot.setpoint[index]
        self.control = autopilot.control[index]
        self.records = _records(autopilot, index)
        self.rotor_count = int(autopilot.rotors[index])
        self.variances = np.diagonal(self.estimator["P"])
        self._position, self._velocity = self.estimator["position"], self.estimator["velocity"]
        self.time_us = -1
        self.time_ms = 0

    def refresh(self, now_us: int) -> None:
        """Set the time, and record whether the estimator has an attitude and a position yet."""
        if now_us != self.time_us:
            self.time_us = now_us
            self.time_ms = now_us // 1000
            self.records.refresh(now_us)

    @property
    def located(self) -> bool:
        """Whether a position fix has been received; an estimate that has lost GPS is still valid."""
        return self.records.located

    @property
    def position(self) -> list[float]:
        """Estimated position, local NED, m."""
        return self._position.tolist()  # type: ignore[no-any-return]

    @property
    def velocity(self) -> list[float]:
        """Estimated velocity, local NED, m/s."""
        return self._velocity.tolist()  # type: ignore[no-any-return]

    def home_z(self) -> float | None:
        """Return the down coordinate of home in the local frame, m, if home is set."""
        home = self.commander.home
        return None if home is None else home.position[2]

    def height_over_home(self) -> float:
        """Return the height over home, or over the local frame's origin while home is not set, m."""
        home = self.commander.home
        return -self.position[2] if home is None else home.position[2] - self.position[2]
