"""The simulator's side of the lockstep, free of ROS."""

from .channels import HostLink
from .participant import Participant
from .server import LockstepServer

__all__ = ["HostLink", "LockstepServer", "Participant"]
