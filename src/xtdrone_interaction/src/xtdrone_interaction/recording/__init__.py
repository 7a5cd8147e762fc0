"""Recorded flights: bags, flight logs, archives and tables, each read into a :class:`.recorded_flight.Recording`."""
