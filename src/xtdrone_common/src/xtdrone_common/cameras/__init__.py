"""Camera geometry: pinholes, lenses with ROS's distortion models, and poses on gimbals."""

from xtdrone_common.cameras.lens_drawing import MOST_GROWTH, Drawing, drawing_of
from xtdrone_common.cameras.lenses import Equidistant, PlumbBob

Lens = PlumbBob | Equidistant

__all__ = ["MOST_GROWTH", "Drawing", "Equidistant", "Lens", "PlumbBob", "drawing_of"]
