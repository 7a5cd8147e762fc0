"""What target speeds of the simulation are allowed."""

from __future__ import annotations

LEAST_SPEED = 0.01
"""Least target real-time factor; below it one 20 ms tick would take longer than two seconds."""
