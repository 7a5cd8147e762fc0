"""The simplified simulator: first- and second-order vehicles, and the swarm's own Leader and Follower without ROS."""

from xtdrone_coordination.network import NetworkOptions
from xtdrone_swarm.simplified.vehicle_parameters import Model
from xtdrone_swarm.swarm import Swarm

__all__ = ["Model", "NetworkOptions", "Swarm"]
