"""Shapes as pictures, rays and physics need them: visuals, triangles, and arithmetic on their poses."""
