"""Correction of setpoints that would bring a vehicle too close to other vehicles or obstacles."""
