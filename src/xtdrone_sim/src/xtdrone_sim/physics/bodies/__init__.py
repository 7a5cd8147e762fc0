"""Solid things beside the vehicles: obstacles, models that move, people."""
