"""Main program of nodes that serve one vehicle: ``NODE.py TYPE ID``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import rospy

from xtdrone_control import lockstep
from xtdrone_control.programs.node_command_line import ArgumentError, served_vehicles


class VehicleNode(Protocol):
    """The node of a vehicle."""

    def step(self) -> Any:
        """Run one turn of the lockstep."""

    def close(self) -> None:
        """Release the node's resources."""


def serve_vehicle(arguments: Sequence[str], suffix: str, rate: float, make: Callable[[str], VehicleNode]) -> None:
    """Run the node of a vehicle until shutdown.

    Args:
        arguments: type and id of the vehicle.
        suffix: the node is called ``TYPE_ID_suffix``.
        rate: turns per second of simulated time, Hz.
        make: creates the node for the vehicle's name.

    Raises:
        ArgumentError: the arguments do not name one vehicle of the fleet.
    """
    _, ids, name = served_vehicles(arguments, rospy.get_param("/xtdrone/fleet", None))
    if len(ids) != 1:
        raise ArgumentError(f"id: {len(ids)} vehicles are not allowed, one per node")
    lockstep.init_node(f"{name}_{suffix}", rate=rate)
    node = make(name)
    try:
        lockstep.start()
        lockstep.spin(node.step)
    finally:
        node.close()
