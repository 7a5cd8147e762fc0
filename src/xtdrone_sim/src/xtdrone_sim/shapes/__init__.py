"""Shapes as images, rays and physics need them: visuals, triangles, and arithmetic on their poses."""
