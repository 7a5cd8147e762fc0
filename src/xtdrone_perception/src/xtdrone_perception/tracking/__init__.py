"""Positions on the ground of people in images, and tracks of them over time."""
