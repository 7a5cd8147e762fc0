"""Metrics of one kind of flight each: formation, search, through obstacles, by odometry."""
