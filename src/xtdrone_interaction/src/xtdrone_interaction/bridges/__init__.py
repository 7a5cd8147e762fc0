"""Bridges from the ROS graph to other clients: Foxglove, rosbridge's protocol, ROS 2."""
