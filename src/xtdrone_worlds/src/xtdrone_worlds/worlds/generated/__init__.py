"""Generators of worlds: forest, maze, indoor and city; ``scenery`` has the countryside."""
