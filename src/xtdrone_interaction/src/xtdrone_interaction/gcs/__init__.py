"""The ground station: plans to and from vehicles over MAVLink, as QGroundControl does it."""

from .station import GcsError, Peer, peers_of, upload_plans

__all__ = ["GcsError", "Peer", "peers_of", "upload_plans"]
