"""Flights through obstacles: each vehicle takes off, is sent to its goal by its planner, and lands there."""
