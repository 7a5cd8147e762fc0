"""The map of all that a vehicle has seen, as octomap's octree: messages, files and the node ``octomap_server.py``."""
