"""Scenery made from a seed: countryside with trees, houses, cars, other things, and people."""

from xtdrone_sim.worlds.scenery.ground import Ground, Rectangle
from xtdrone_sim.worlds.scenery.outdoor import LIGHTS, Options, is_free, outdoor

__all__ = ["LIGHTS", "Ground", "Options", "Rectangle", "is_free", "outdoor"]
