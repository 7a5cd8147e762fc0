"""Coordination of many vehicles: formation patterns, assignment, topology, consensus, avoidance, leader and follower.

The folders: ``laws`` (consensus, avoidance, topology), ``patterns``, ``batch`` (many followers at once),
``network`` (radios), ``search``. Only ``follower_nodes``, ``leader_node``, ``search.search_node`` and the programs
in ``nodes/`` depend on ROS.
"""
