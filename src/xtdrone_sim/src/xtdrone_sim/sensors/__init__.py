"""Sensors of the autopilots and their failures, ground truth, and the frame of sensor nodes."""
