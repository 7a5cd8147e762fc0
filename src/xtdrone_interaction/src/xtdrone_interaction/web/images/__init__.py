"""Images of camera topics."""
