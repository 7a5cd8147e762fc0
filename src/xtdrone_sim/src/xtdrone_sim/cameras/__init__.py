"""Cameras: images and depths of the scene, their lenses, exposures and messages, and the node."""
