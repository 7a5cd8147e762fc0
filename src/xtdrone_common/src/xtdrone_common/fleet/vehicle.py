"""A vehicle: its name, model, MAVLink id, UDP ports and start pose, numbered as in upstream XTDrone.

The name of a vehicle is ``<type>_<index in its type>``; its id counts over all types and determines its MAVLink system
id and ports. Its model, the description of its body and sensors, has the name of its type unless another one is given:
upstream's ``iris_stereo_camera`` flies as ``iris_0``.

The offboard link has upstream's ports, or those of PX4's own simulations: ``OFFBOARD_PORTS``.

Several simulations can run side by side on one machine as *instances*: the ports of instance N are N times
``INSTANCE_STEP`` higher than those of instance 0, which are upstream's. MAVLink system ids are the same in all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

COMMAND_TOPICS = ("cmd", *(f"cmd_{kind}_{frame}" for kind in ("pose", "vel", "accel") for frame in ("enu", "flu")))
"""XTDrone's command topics of a vehicle, below ``/xtdrone/<name>/``; its communication node subscribes to them."""

MAX_VEHICLES = 250  # MAVLink system ids are 1..255; ground stations use 255

_GCS_LOCAL_PORT = 18570
_PAYLOAD_LOCAL_PORT = 14280
_PAYLOAD_REMOTE_PORT = 14030
_SIMULATOR_TCP_PORT = 4560
GCS_REMOTE_PORT = 14550  # of instance 0

INSTANCE_STEP = 540
"""Offset of the ports between instances; the ports of 250 vehicles in each instance never collide."""

MAX_INSTANCE = 7


class OffboardPorts(NamedTuple):
    """UDP ports of the offboard links of a fleet in instance 0; those of vehicle i are i higher.

    Attributes:
        local: the autopilot's end.
        remote: the end of MAVROS, or of another program on board.
        vehicles: the largest number of vehicles.
    """

    local: int
    remote: int
    vehicles: int


XTDRONE, PX4 = "xtdrone", "px4"
OFFBOARD_PORTS = {
    XTDRONE: OffboardPorts(34580, 24540, MAX_VEHICLES),
    PX4: OffboardPorts(14580, 14540, GCS_REMOTE_PORT - 14540),  # the next one would have the ground station's
}
"""By the names of the argument ``ports``: upstream XTDrone's, and those of PX4's ``px4-rc.mavlink``."""


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


def check_ports(value: object) -> str:
    """Return the name of the offboard links' ports, a key of ``OFFBOARD_PORTS``.

    Raises:
        FleetError: another value.
    """
    if not (isinstance(value, str) and value in OFFBOARD_PORTS):
        raise FleetError(f"ports: {repr(value)[:40]} is not allowed, {' or '.join(OFFBOARD_PORTS)}")
    return value


class StartPose(NamedTuple):
    """The position and attitude at which a vehicle starts, in the map frame (ENU).

    Attributes:
        x: east of the map's origin, m.
        y: north, m.
        z: height of the vehicle's lowest point above the ground plane, m.
        roll: about the forward axis, rad; the three angles are those of Gazebo, applied about fixed axes.
        pitch: about the left axis, rad; positive is nose down.
        yaw: about the vertical, rad, counter-clockwise; 0 faces east.
    """

    x: float
    y: float
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0


@dataclass(frozen=True)
class Vehicle:
    """One vehicle of the fleet.

    Attributes:
        type: the name's first part, such as ``iris``.
        index: index within its type, from 0.
        id: index over all types, from 0.
        instance: number of the simulation on this machine.
        model: name of its description, or a YAML file; empty: that of its type.
        pose: start pose; None for its place on the spawn grid.
        ports: those of its offboard link, a key of ``OFFBOARD_PORTS``.
    """

    type: str
    index: int
    id: int
    instance: int = 0
    model: str = ""
    pose: StartPose | None = None
    ports: str = XTDRONE

    def __post_init__(self) -> None:
        if not self.model:
            object.__setattr__(self, "model", self.type)

    @property
    def name(self) -> str:
        """ROS namespace, and name in the simulator, such as ``iris_0``."""
        return f"{self.type}_{self.index}"

    @property
    def system_id(self) -> int:
        """MAVLink system id (MAV_SYS_ID, MAVROS's tgt_system)."""
        return self.id + 1

    @property
    def offboard_local_port(self) -> int:
        """UDP port that the autopilot binds for the offboard link."""
        return instance_port(OFFBOARD_PORTS[self.ports].local + self.id, self.instance)

    @property
    def offboard_remote_port(self) -> int:
        """UDP port that MAVROS binds for the offboard link."""
        return instance_port(OFFBOARD_PORTS[self.ports].remote + self.id, self.instance)

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
