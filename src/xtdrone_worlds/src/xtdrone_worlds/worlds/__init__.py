"""Worlds: their files, generators, scenery, people and types of robots."""
