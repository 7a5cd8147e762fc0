"""Exploration of a floor: a map at flight height, its frontiers, and regions divided among several vehicles."""
