"""Bridges from the ROS graph to other clients: Foxglove, rosbridge protocol, ROS 2."""
