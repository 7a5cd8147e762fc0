"""Poses of others' odometry and SLAM (VINS-Fusion, FAST-LIO, A-LOAM, ...) for the autopilot, as upstream's programs."""
