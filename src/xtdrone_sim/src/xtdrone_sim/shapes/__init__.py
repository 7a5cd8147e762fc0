"""Shapes for images, rays and physics: visuals, triangles, and arithmetic on their poses."""
