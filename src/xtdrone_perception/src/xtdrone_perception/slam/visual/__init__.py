"""Odometry by a depth camera or a stereo pair: node ``visual_odometry.py``."""
