"""Gazebo's names, states and limits for models, vehicles and people, and its services."""
