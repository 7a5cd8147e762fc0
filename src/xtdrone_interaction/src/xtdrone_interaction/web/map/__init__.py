"""Missions and searches on the map."""
