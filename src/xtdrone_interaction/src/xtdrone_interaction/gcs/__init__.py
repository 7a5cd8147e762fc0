"""A ground station for many vehicles over MAVLink: states, commands, plans, parameters and logs.

``GroundStation`` runs the exchanges of ``exchanges`` with vehicles; ``commands`` is the command line.
"""

from .peers import GcsError, Peer, peers_of
from .station import GroundStation, upload_plans

__all__ = ["GcsError", "GroundStation", "Peer", "peers_of", "upload_plans"]
