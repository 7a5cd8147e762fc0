"""Models in SDF and YAML files: URIs, links as rigid bodies, joints."""
