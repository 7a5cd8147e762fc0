"""Exploration of a floor: a map at the height of flight, its frontiers, and vehicles that share its regions."""
