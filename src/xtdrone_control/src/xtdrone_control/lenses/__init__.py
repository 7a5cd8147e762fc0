"""Lenses that distort a camera's picture, by ROS's distortion models, and how their pictures are drawn."""

from xtdrone_control.lenses.equidistant import Equidistant
from xtdrone_control.lenses.lens_drawing import MOST_GROWTH, Drawing, drawing_of
from xtdrone_control.lenses.plumb_bob import PlumbBob

Lens = PlumbBob | Equidistant

__all__ = ["MOST_GROWTH", "Drawing", "Equidistant", "Lens", "PlumbBob", "drawing_of"]
