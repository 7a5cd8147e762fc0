"""Rigid bodies: dynamics of vehicles, contacts, movable models and their joints, forces by request, batteries."""
