"""Loop closure on top of lidar odometry: node ``loop_closure.py``."""
