"""TCP ports of servers, chosen so that several simulations on one machine do not collide."""

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
    """Return the port to listen on: the default port shifts with the instance, like the MAVLink ports.

    Args:
        port: that of the settings.
        usual: the default of the settings; any other port was chosen by the user and is kept.
    """
    return instance_port(port, instance_here()) if port == usual else port
