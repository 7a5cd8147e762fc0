"""Flights through obstacles: each vehicle takes off, flies to its goal by its planner, and lands there."""
