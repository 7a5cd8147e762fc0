"""Relative localisation: where the other vehicles are, from ranges, bearings and odometry."""
