"""PX4's parameters: values, files, dependencies between them, metadata for ground stations (PX4: lib/parameters)."""
