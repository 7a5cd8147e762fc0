"""Types of robots on the ground and on water: their settings, models in the world, URDFs and tags."""
