"""Cooperative search: ``mission_control`` decides, ``search_node`` connects it to ROS."""
