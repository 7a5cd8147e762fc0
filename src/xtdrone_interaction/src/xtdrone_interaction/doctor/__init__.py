"""``./xtdrone doctor``: reasons why vehicles of a running simulation do not arm, fly or send data."""
