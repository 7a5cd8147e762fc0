"""Sensors, gimbals and landing gear that a vehicle's YAML mounts on its links."""
