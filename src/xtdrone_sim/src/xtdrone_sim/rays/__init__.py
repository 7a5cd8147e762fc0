"""Rays against everything in a world: ``scene.RayScene`` and its compiled kernels."""
