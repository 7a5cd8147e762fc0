"""Merging of the maps of several vehicles, each in its own frame, through relative poses: node ``map_merging.py``."""
