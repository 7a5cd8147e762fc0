"""Smooth, collision-free trajectories over time, within limits of speed and acceleration."""
