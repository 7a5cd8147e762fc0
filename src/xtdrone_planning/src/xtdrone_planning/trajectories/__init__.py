"""Smooth trajectories with time, within limits of speed and acceleration, clear of obstacles."""
