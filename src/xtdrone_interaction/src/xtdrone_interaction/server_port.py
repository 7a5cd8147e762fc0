"""The TCP port of a server beside a simulation, so that several simulations on one machine do not compete."""

from __future__ import annotations

import rospy

from xtdrone_control.fleet import FleetError, check_instance, instance_port

_INSTANCE = "/xtdrone/instance"


def instance_here() -> int:
    """Return the number of this ROS master's simulation on its machine, 0 without one."""
    try:
        return check_instance(rospy.get_param(_INSTANCE, 0))
    except FleetError:
        return 0


def port_here(port: int, usual: int) -> int:
    """Return the port to listen on: the usual one moves with the instance, as the MAVLink ports do.

    Args:
        port: that of the settings.
        usual: the default of the settings; another port was chosen by the user and stays.
    """
    return instance_port(port, instance_here()) if port == usual else port
