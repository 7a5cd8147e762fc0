"""The formation flight as a mission: over ROS, or over a swarm in one process."""
