"""Back ends that fly the vehicles: the built-in autopilot, and PX4s connected by HIL messages."""
