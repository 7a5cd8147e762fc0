"""Odometry and SLAM of one vehicle by lidar, laser or camera, and the poses of other programs for its autopilot."""
