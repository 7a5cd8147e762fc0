"""Vehicle types by YAML and URDF, and their moving joints and links."""
