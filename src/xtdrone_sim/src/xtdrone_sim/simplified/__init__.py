"""The simplified simulator: first- and second-order vehicles, and the swarm's own Leader and Follower without ROS."""

from xtdrone_coordination.network import NetworkOptions

from .model import Model
from .swarm import Swarm

__all__ = ["Model", "NetworkOptions", "Swarm"]
