"""Which vehicles fly: names, MAVLink ids and UDP ports, as upstream XTDrone numbers them.

A fleet is written ``"iris:9"`` or ``"iris:3,typhoon_h480:2"``. A vehicle's name is ``<type>_<index in its type>``;
its global index runs over all types and fixes its MAVLink system id and its ports.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

MAX_VEHICLES = 250  # MAVLink system ids are 1..255; 255 is the ground station's

_OFFBOARD_LOCAL_PORT = 34580  # the autopilot's end of the offboard link
_OFFBOARD_REMOTE_PORT = 24540  # MAVROS's end
_GCS_LOCAL_PORT = 18570
_PAYLOAD_LOCAL_PORT = 14280
_PAYLOAD_REMOTE_PORT = 14030
_SIMULATOR_TCP_PORT = 4560
GCS_REMOTE_PORT = 14550


class FleetError(ValueError):
    """A fleet description that cannot be flown."""


@dataclass(frozen=True)
class Vehicle:
    """One vehicle of the fleet.

    Attributes:
        type: model name, as ``iris``.
        index: number within its type, from 0.
        id: number over all types, from 0.
    """

    type: str
    index: int
    id: int

    @property
    def name(self) -> str:
        """ROS namespace and model name, as ``iris_0``."""
        return f"{self.type}_{self.index}"

    @property
    def system_id(self) -> int:
        """MAVLink system id (MAV_SYS_ID, MAVROS's tgt_system)."""
        return self.id + 1

    @property
    def offboard_local_port(self) -> int:
        """UDP port that the autopilot binds for the offboard link."""
        return _OFFBOARD_LOCAL_PORT + self.id

    @property
    def offboard_remote_port(self) -> int:
        """UDP port that MAVROS binds for the offboard link."""
        return _OFFBOARD_REMOTE_PORT + self.id

    @property
    def gcs_local_port(self) -> int:
        """UDP port that the autopilot binds for the ground-station link."""
        return _GCS_LOCAL_PORT + self.id

    @property
    def payload_local_port(self) -> int:
        """UDP port that the autopilot binds for the payload link."""
        return _PAYLOAD_LOCAL_PORT + self.id

    @property
    def payload_remote_port(self) -> int:
        """UDP port of the payload's end of that link."""
        return _PAYLOAD_REMOTE_PORT + self.id

    @property
    def simulator_tcp_port(self) -> int:
        """TCP port of PX4's simulator link."""
        return _SIMULATOR_TCP_PORT + self.id

    @property
    def fcu_url(self) -> str:
        """MAVROS's fcu_url for this vehicle."""
        return f"udp://:{self.offboard_remote_port}@localhost:{self.offboard_local_port}"


def parse_fleet(text: str) -> tuple[Vehicle, ...]:
    """Return the vehicles that ``text`` describes, in order of their global index.

    Args:
        text: comma-separated ``type:count``, as ``"iris:9"``; a bare ``type`` counts one.

    Raises:
        FleetError: a malformed entry, a count that is not in 1..250 in all, or a type named twice.
    """
    vehicles: list[Vehicle] = []
    seen: set[str] = set()
    for entry in text.split(","):
        match = re.fullmatch(r"\s*([a-z][a-z0-9_]*)(?:\s*:\s*(-?\d+))?\s*", entry)
        if match is None:
            raise FleetError(f"vehicles: {entry!r} is not of the form type:count, as iris:9")
        kind, count = match[1], int(match[2] or 1)
        if kind in seen:
            raise FleetError(f"vehicles: type {kind!r} is named twice in {text!r}")
        seen.add(kind)
        if count < 1 or len(vehicles) + count > MAX_VEHICLES:
            raise FleetError(f"vehicles: {count} of type {kind!r}: 1 to {MAX_VEHICLES} vehicles in all are allowed")
        vehicles += [Vehicle(kind, i, len(vehicles) + i) for i in range(count)]
    return tuple(vehicles)


def spawn_grid(fleet: tuple[Vehicle, ...], rows: int) -> list[tuple[float, float, float]]:
    """Return each vehicle's spawn place on upstream's grid, in metres ENU (x, y, z).

    x = 3 (rows before this type + index mod rows), y = 3 (index div rows + 1), z = 0, where ``rows`` vehicles stand
    side by side along x and each type starts a block of its own.

    Raises:
        FleetError: ``rows`` is less than 1.
    """
    if rows < 1:
        raise FleetError(f"rows: {rows} is not allowed, at least 1")
    places = []
    types = list(dict.fromkeys(v.type for v in fleet))
    for vehicle in fleet:
        before = types.index(vehicle.type) * rows
        x = 3.0 * (before + vehicle.index % rows)
        y = 3.0 * (vehicle.index // rows + 1)
        places.append((x, y, 0.0))
    return places
