"""Forwarding of poses from third-party odometry and SLAM (VINS-Fusion, FAST-LIO, A-LOAM, ...) to the autopilot."""
