"""Matplotlib figures of recordings; no display, no ROS."""
