"""Scenery generated from a seed: countryside with trees, houses, cars, other objects and people."""

from xtdrone_worlds.worlds.scenery.countryside_layout import LIGHTS, OutdoorOptions, is_free, outdoor
from xtdrone_worlds.worlds.scenery.start_area_and_ground import FreeGround, Rectangle

__all__ = ["LIGHTS", "FreeGround", "OutdoorOptions", "Rectangle", "is_free", "outdoor"]
