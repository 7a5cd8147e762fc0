"""Vehicles of a fleet: names, MAVLink ids and UDP ports, numbered as in upstream XTDrone.

A fleet is described as ``"iris:9"`` or ``"iris:3,typhoon_h480:2"``. The name of a vehicle is ``<type>_<index in its
type>``; its global index counts over all types and determines its MAVLink system id and ports.

Several simulations can run side by side on one machine as *instances*: the ports of instance N are N times
``INSTANCE_STEP`` higher than those of instance 0, which are upstream's. MAVLink system ids are the same in all of them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

MAX_VEHICLES = 250  # MAVLink system ids are 1..255; ground stations use 255

_OFFBOARD_LOCAL_PORT = 34580  # the autopilot's end of the offboard link
_OFFBOARD_REMOTE_PORT = 24540  # MAVROS's end
_GCS_LOCAL_PORT = 18570
_PAYLOAD_LOCAL_PORT = 14280
_PAYLOAD_REMOTE_PORT = 14030
_SIMULATOR_TCP_PORT = 4560
GCS_REMOTE_PORT = 14550  # of instance 0

INSTANCE_STEP = 540
"""Offset of the ports between instances; the ports of 250 vehicles in each instance never collide."""

MAX_INSTANCE = 7


class FleetError(ValueError):
    """An invalid description of a fleet, or an invalid instance."""


def instance_port(port: int, instance: int) -> int:
    """Return the port in ``instance`` that corresponds to ``port`` in instance 0."""
    return port + INSTANCE_STEP * instance


def check_instance(value: object) -> int:
    """Return the number of an instance, given as a number or as text.

    Raises:
        FleetError: not a whole number in 0..MAX_INSTANCE.
    """
    text = str(value).strip()
    if isinstance(value, bool) or not (text.isascii() and text.isdecimal() and int(text) <= MAX_INSTANCE):
        raise FleetError(f"instance: {value!r} is not allowed, a whole number from 0 to {MAX_INSTANCE}")
    return int(text)


@dataclass(frozen=True)
class Vehicle:
    """One vehicle of the fleet.

    Attributes:
        type: model name, as ``iris``.
        index: index within its type, from 0.
        id: index over all types, from 0.
        instance: number of the simulation on this machine.
    """

    type: str
    index: int
    id: int
    instance: int = 0

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
        return instance_port(_OFFBOARD_LOCAL_PORT + self.id, self.instance)

    @property
    def offboard_remote_port(self) -> int:
        """UDP port that MAVROS binds for the offboard link."""
        return instance_port(_OFFBOARD_REMOTE_PORT + self.id, self.instance)

    @property
    def gcs_local_port(self) -> int:
        """UDP port that the autopilot binds for the ground-station link."""
        return instance_port(_GCS_LOCAL_PORT + self.id, self.instance)

    @property
    def gcs_remote_port(self) -> int:
        """UDP port of the ground station, to which the autopilot streams from the start; shared by all vehicles."""
        return instance_port(GCS_REMOTE_PORT, self.instance)

    @property
    def payload_local_port(self) -> int:
        """UDP port that the autopilot binds for the payload link."""
        return instance_port(_PAYLOAD_LOCAL_PORT + self.id, self.instance)

    @property
    def payload_remote_port(self) -> int:
        """UDP port that the payload binds for the payload link."""
        return instance_port(_PAYLOAD_REMOTE_PORT + self.id, self.instance)

    @property
    def simulator_tcp_port(self) -> int:
        """TCP port of PX4's simulator link."""
        return instance_port(_SIMULATOR_TCP_PORT + self.id, self.instance)

    @property
    def fcu_url(self) -> str:
        """MAVROS's fcu_url for this vehicle."""
        return f"udp://:{self.offboard_remote_port}@localhost:{self.offboard_local_port}"


def parse_fleet(text: str, instance: int = 0) -> tuple[Vehicle, ...]:
    """Return the vehicles that ``text`` describes, in order of their global index.

    Args:
        text: comma-separated ``type:count``, as ``"iris:9"``; ``type`` alone means one.
        instance: number of the simulation on this machine, which offsets the ports.

    Raises:
        FleetError: a malformed entry, a total not in 1..250, a type named twice, or an invalid instance.
    """
    check_instance(instance)
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
        vehicles += [Vehicle(kind, i, len(vehicles) + i, instance) for i in range(count)]
    return tuple(vehicles)


def spawn_grid(fleet: tuple[Vehicle, ...], rows: int) -> list[tuple[float, float, float]]:
    """Return the spawn position of each vehicle on upstream's grid, in metres ENU (x, y, z).

    x = 3 (rows before this type + index mod rows), y = 3 (index div rows + 1), z = 0, where ``rows`` vehicles stand
    side by side along x and each type starts a separate block.

    Raises:
        FleetError: ``rows`` is less than 1.
    """
    if rows < 1:
        raise FleetError(f"rows: {rows} is not allowed, at least 1")
    positions = []
    types = list(dict.fromkeys(v.type for v in fleet))
    for vehicle in fleet:
        before = types.index(vehicle.type) * rows
        x = 3.0 * (before + vehicle.index % rows)
        y = 3.0 * (vehicle.index // rows + 1)
        positions.append((x, y, 0.0))
    return positions
