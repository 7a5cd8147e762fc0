"""Robots in the simulation: drives of wheels and boats, and topics."""
