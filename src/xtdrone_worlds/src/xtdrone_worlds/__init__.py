"""What a simulated world consists of: shapes, meshes, SDF, generated worlds, scenery, models."""
