"""Positions on Earth: PX4's map projection and its origin, height of the geoid."""
