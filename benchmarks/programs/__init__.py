"""Benchmarks that need no ROS graph of their own: each measures one part and can be run alone."""
