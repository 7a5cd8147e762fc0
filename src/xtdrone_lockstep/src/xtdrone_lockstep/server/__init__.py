"""The simulator's side of the lockstep, free of ROS."""

from .channels import HostLink
from .lockstep_server import LockstepServer
from .participant import Participant

__all__ = ["HostLink", "LockstepServer", "Participant"]
