"""Solid objects other than the vehicles: obstacles, movable models, people."""
