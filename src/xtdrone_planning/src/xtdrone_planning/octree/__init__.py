"""Map of everything that a vehicle has seen, as an octomap octree: messages, files and the node
``octomap_server.py``."""
