"""Poses of odometry and SLAM of others (VINS-Fusion, FAST-LIO, A-LOAM, ...) for the autopilot, as upstream's programs."""
