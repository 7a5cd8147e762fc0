"""Shapes for images, rays and physics: visuals, collision shapes and triangles."""
