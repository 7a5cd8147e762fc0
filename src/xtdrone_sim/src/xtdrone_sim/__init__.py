"""A simulator of multirotors, robots and people in lockstep with ROS nodes."""
