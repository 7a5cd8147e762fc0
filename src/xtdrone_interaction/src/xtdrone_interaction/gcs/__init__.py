"""A ground station for many vehicles over MAVLink: their state, commands, plans, as QGroundControl has them.

``GroundStation`` is the library; ``command`` and the ``..._command`` modules are the command line around it.
"""

from .peers import GcsError, Peer, peers_of
from .station import GroundStation, upload_plans

__all__ = ["GcsError", "GroundStation", "Peer", "peers_of", "upload_plans"]
