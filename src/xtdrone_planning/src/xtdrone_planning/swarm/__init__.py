"""Trajectories of several vehicles that keep clear of each other, agreed on by radio."""
