"""Range of the simulation's target speed."""

from __future__ import annotations

LEAST_SPEED = 0.01
"""Least target real-time factor; below it a 20 ms tick would take more than two seconds."""
