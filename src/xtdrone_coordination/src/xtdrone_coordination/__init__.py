"""Coordination of many vehicles: formation patterns, assignment, topology, consensus, avoidance, leader and follower.

Only ``ros`` and the programs in ``nodes/`` know ROS; everything else is numbers in, numbers out.
"""
