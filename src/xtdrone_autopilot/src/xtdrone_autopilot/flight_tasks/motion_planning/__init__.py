"""Smooth motion to a goal: jerk, speed and direction limited (PX4: lib/motion_planning)."""
