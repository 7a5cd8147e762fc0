"""``./xtdrone compare-px4``: our autopilot beside recorded flights of a real PX4."""
