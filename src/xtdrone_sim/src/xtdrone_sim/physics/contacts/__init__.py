"""Contacts of vehicles: which are near something, which sleep, and where they touch."""
