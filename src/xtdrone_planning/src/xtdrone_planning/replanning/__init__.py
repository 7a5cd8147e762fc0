"""Planner of one vehicle: its state machine from goal to hover, and its ROS node."""
