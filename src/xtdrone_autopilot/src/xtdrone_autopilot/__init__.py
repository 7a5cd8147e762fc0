"""The autopilot, modelled on PX4 v1.14 without ROS: inner loops as kernels, mode logic in Python."""
