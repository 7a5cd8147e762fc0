"""UWB sensors: ranges and bearings between vehicles, with their line of sight, and the node."""
