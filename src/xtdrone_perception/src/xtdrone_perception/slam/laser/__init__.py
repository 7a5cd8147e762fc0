"""Odometry by a 2D laser and a range finder: node ``laser_odometry.py``."""
