"""A ground station for many PX4 vehicles over MAVLink: states, commands, plans, parameters and logs.

``GroundStation`` runs the exchanges of ``exchanges`` with vehicles over UDP, TCP and serial ports.
"""

from .station import GroundStation, upload_plans
from .vehicle_addresses import GcsError, Peer, peers_of

__all__ = ["GcsError", "GroundStation", "Peer", "peers_of", "upload_plans"]
