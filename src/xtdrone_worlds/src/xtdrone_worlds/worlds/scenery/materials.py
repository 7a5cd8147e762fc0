"""Materials of a scene: colours, textures and shapes, some of which are reserved for test scenes."""

from __future__ import annotations

import colorsys
import math
from pathlib import Path

import numpy as np

from xtdrone_common.settings import check_choice
from xtdrone_worlds.shapes.visual import Colour
from xtdrone_worlds.worlds.scenery import assets

SPLITS = ("all", "train", "test")


class Kit:
    """Random choice of a split's materials; train and test share no colour, texture or shape."""

    def __init__(self, split: str, rng: np.random.Generator) -> None:
        """Select the materials of all scenes or of one side of the split.

        Args:
            split: all, train or test.
            rng: random generator of all choices.

        Raises:
            ValueError: unknown split.
        """
        self._split = check_choice("split", split, SPLITS)
        self.rng = rng

    def _number(self, count: int) -> int:
        """Return a number below ``count``; of several, the last third is reserved for test scenes."""
        kept = math.ceil(count / 3) if count > 1 else 0
        if self._split == "test" and kept:
            return int(self.rng.integers(count - kept, count))
        return int(self.rng.integers(count - kept if self._split == "train" else count))

    def texture(self, kind: str) -> Path:
        """Return the file of a random texture."""
        return assets.texture(kind, self._number(assets.texture_count(kind)))

    def mesh(self, kind: str) -> Path:
        """Return the file of a random mesh."""
        return assets.mesh(kind, self._number(assets.mesh_count(kind)))

    def uniform(self, low: float, high: float) -> float:
        """Return a random number, rounded to 0.001."""
        return round(float(self.rng.uniform(low, high)), 3)

    def hsv(self, hue: tuple[float, float], saturation: tuple[float, float], value: tuple[float, float]) -> Colour:
        """Return a random colour; of 16 intervals of the hue, every second one is reserved for test scenes."""
        low, high = hue
        bin_ = int(self.rng.integers(8)) * 2
        bin_ += int(self._split == "test") if self._split != "all" else int(self.rng.integers(2))
        at = low + (high - low) * (bin_ + self.rng.uniform(0.1, 0.9)) / 16
        red, green, blue = colorsys.hsv_to_rgb(at % 1.0, self.rng.uniform(*saturation), self.rng.uniform(*value))
        return (round(red, 3), round(green, 3), round(blue, 3), 1.0)

    def any_colour(self) -> Colour:
        """Return a random colour of paint or cloth: coloured, or grey from black to white."""
        if self.rng.uniform() < 0.4:
            return self.hsv((0.0, 1.0), (0.0, 0.08), (0.08, 0.95))
        return self.hsv((0.0, 1.0), (0.35, 0.9), (0.25, 0.9))

    def green(self) -> Colour:
        """Return a random colour of leaves, occasionally in autumn."""
        if self.rng.uniform() < 0.12:
            return self.hsv((0.03, 0.16), (0.5, 0.8), (0.5, 0.85))
        return self.hsv((0.2, 0.38), (0.35, 0.7), (0.3, 0.65))

    def brown(self) -> Colour:
        """Return a random colour of bark or wood."""
        return self.hsv((0.05, 0.11), (0.3, 0.6), (0.3, 0.6))

    def grey(self) -> Colour:
        """Return a random colour of stone or metal."""
        return self.hsv((0.0, 1.0), (0.0, 0.1), (0.35, 0.85))
