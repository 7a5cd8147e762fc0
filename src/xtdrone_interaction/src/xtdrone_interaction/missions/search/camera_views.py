"""The images of all cameras in a grid with captions, for the film of a search. ROS is not needed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]

_TILE = (480, 270)  # pixels, width and height of one view
_LINE = 22  # pixels, height of a caption
_COLUMNS = 3
_DARK = (32, 32, 32)
_LIGHT = (235, 235, 235)
_MARKED = (255, 200, 60)


class Views:
    """The latest image of each camera, drawn as a grid.

    Attributes:
        names: vehicles, in the order of the tiles.
        size: width and height of the grid, pixels; even, as video encoders require.
    """

    def __init__(self, names: Sequence[str]) -> None:
        """Start without images."""
        self.names = tuple(names)
        self._pictures: dict[str, tuple[float, Picture]] = {}
        self._words: dict[str, str] = {}
        self._columns = min(_COLUMNS, max(1, len(self.names)))
        rows = math.ceil(len(self.names) / self._columns)
        self.size = (self._columns * _TILE[0], rows * (_TILE[1] + _LINE) + _LINE)

    def set_image(self, name: str, time: float, picture: Picture) -> None:
        """Set the latest image of a camera.

        Args:
            name: the vehicle.
            time: of the exposure, s.
            picture: RGB, shape (h, w, 3).
        """
        self._pictures[name] = (time, picture)

    def set_captions(self, words: Mapping[str, str]) -> None:
        """Set the captions, by vehicle name."""
        self._words.update(words)

    def draw(self, title: str) -> Picture:
        """Return the grid, RGBA, shape (height, width, 4).

        Args:
            title: the line below all views.
        """
        width, height = self.size
        canvas = np.full((height, width, 3), _DARK, np.uint8)
        for number, name in enumerate(self.names):
            row, column = divmod(number, self._columns)
            self._draw_tile(canvas, name, column * _TILE[0], row * (_TILE[1] + _LINE))
        _write(canvas, title, 8, height - 7, _LIGHT)
        return np.dstack([canvas, np.full((height, width), 255, np.uint8)])

    def _draw_tile(self, canvas: Picture, name: str, left: int, top: int) -> None:
        words = self._words.get(name, "")
        caption = f"{name}  {words}"
        if name in self._pictures:
            time, picture = self._pictures[name]
            tile = cv2.resize(picture, _TILE, interpolation=cv2.INTER_AREA)
            canvas[top + _LINE : top + _LINE + _TILE[1], left : left + _TILE[0]] = tile
            caption = f"{name}  {time:.1f} s  {words}"
        _write(canvas, caption, left + 8, top + _LINE - 7, _MARKED if words in _WATCHED else _LIGHT)


_WATCHED = ("second look", "following")


def _write(canvas: Picture, text: str, x: int, y: int, colour: tuple[int, int, int]) -> None:
    cv2.putText(canvas, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
