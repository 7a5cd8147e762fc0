"""Events and texts for ground stations (PX4: lib/events)."""
