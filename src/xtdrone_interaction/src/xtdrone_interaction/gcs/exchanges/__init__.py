"""Exchanges of a ground station with one vehicle, as generators without sockets or clocks; see ``exchange``."""
