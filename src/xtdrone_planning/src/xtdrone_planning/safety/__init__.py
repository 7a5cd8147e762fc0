"""Correction of setpoints that would bring a vehicle too near to others or to obstacles."""
