"""The simulator as a ROS node: clock, lockstep, full simulation, digests, and vehicles of launch files."""
