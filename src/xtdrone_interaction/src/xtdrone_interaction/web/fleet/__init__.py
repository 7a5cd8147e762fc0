"""State of the fleet and its surroundings for the page."""
