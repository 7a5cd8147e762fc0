"""The radio network between the vehicles: :class:`Network` and its settings, :class:`NetworkOptions`."""

from xtdrone_control.network.network_options import MESSAGE_BITS, NetworkOptions

from .radio_network import KnownSwarm, Near, Network, Samples, make_network

__all__ = ["MESSAGE_BITS", "KnownSwarm", "Near", "Network", "NetworkOptions", "Samples", "make_network"]
