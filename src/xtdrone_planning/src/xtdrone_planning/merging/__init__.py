"""Maps of several vehicles, each in a frame of its own, merged through relative poses: node ``map_merging.py``."""
