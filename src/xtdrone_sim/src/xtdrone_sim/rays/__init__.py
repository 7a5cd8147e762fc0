"""Ray casting in a world: ``scene.RayScene`` and its compiled kernels."""
