"""Relative localisation: positions of the other vehicles from ranges, bearings and odometry."""
