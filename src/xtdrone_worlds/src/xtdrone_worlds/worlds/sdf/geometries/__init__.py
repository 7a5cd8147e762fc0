"""Geometry of SDF links: visuals and collisions, meshes, heightmaps, materials."""
