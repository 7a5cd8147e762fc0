"""The parameter ``/xtdrone/fleet``, which the simulator's launch file sets and each joining vehicle extends."""

from __future__ import annotations

import time

import rospy

from xtdrone_control.programs.node_command_line import fleet_of

FLEET_PARAMETER = "/xtdrone/fleet"
_POLL_PERIOD = 0.2  # s of wall time: the parameter server sends no notification to a node that is not initialised


def wait_for_fleet(vehicle: str = "") -> str:
    """Wait until ``/xtdrone/fleet`` is set, and lists a vehicle.

    Args:
        vehicle: its name, such as ``iris_9``; empty: any fleet will do.

    Returns:
        The parameter.

    Raises:
        ArgumentError: the parameter is malformed.
        ROSInterruptException: the node was shut down while waiting.
    """
    while not _lists(fleet := str(rospy.get_param(FLEET_PARAMETER, "")), vehicle):
        if rospy.is_shutdown():
            raise rospy.ROSInterruptException("shutdown")
        time.sleep(_POLL_PERIOD)
    return fleet


def _lists(fleet: str, vehicle: str) -> bool:
    there = fleet_of(fleet or None) or ()
    return any(vehicle in ("", one.name) for one in there)
