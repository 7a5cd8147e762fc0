"""Scenery made from a seed: countryside with trees, houses, cars, other things, and people."""

from .ground import Ground, Rectangle
from .outdoor import LIGHTS, Options, is_free, outdoor

__all__ = ["LIGHTS", "Ground", "Options", "Rectangle", "is_free", "outdoor"]
