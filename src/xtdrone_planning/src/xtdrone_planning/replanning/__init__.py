"""Planner of a vehicle, alone or in agreement with others by radio: state machine from goal to hover, and ROS node."""
