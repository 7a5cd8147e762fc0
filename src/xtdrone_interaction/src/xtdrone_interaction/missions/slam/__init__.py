"""The flight by odometry alone, without GPS."""
