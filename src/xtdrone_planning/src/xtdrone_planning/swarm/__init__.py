"""Collision-free trajectories of several vehicles, coordinated by radio."""
