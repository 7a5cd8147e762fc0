"""Checks of the simulator against recorded flights, against itself, and over hours."""
