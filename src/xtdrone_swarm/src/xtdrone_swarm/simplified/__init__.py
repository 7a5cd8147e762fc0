"""Simplified vehicles: kinematics of first and second order, an autopilot, and their node."""
