"""How many pictures a second are drawn off-screen."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from .scene import Frame, SwarmView

SIZE = (640, 480)  # pixels
_PERIOD = 1.0 / 15.0  # s of simulated time between two frames
_LISTENED = 2  # vehicles that each one listens to


def frames(count: int, number: int) -> Iterator[Frame]:
    """Yield frames of a lattice that sways as a whole while its vehicles circle around their slots.

    Args:
        count: vehicles.
        number: frames.
    """
    side = int(np.ceil(count ** (1.0 / 3.0)))
    index = np.arange(count)
    lattice = 3.0 * np.stack([index % side, index // side % side, index // side**2], axis=1) + [0.0, 0.0, 5.0]
    later = np.repeat(np.arange(1, count), _LISTENED)
    edges = np.stack([later, np.maximum(0, later - np.tile([1, side], count - 1))], axis=1)
    for k in range(number):
        time_s = k * _PERIOD
        slots = lattice + np.array([1.5 * time_s, 2.0 * np.sin(0.5 * time_s), 0.0])
        phase = time_s + index
        circle = 1.2 * np.stack([np.cos(phase), np.sin(phase), 0.3 * np.sin(2.0 * phase)], axis=1)
        yield Frame(time_s, slots + circle, slots, edges, "lattice", "benchmark")


def measure(count: int, number: int = 60, size: tuple[int, int] = SIZE) -> float:
    """Return how many pictures a second are drawn, with trails, topology and slots, by wall time.

    Args:
        count: vehicles, at least 2.
        number: pictures that are measured, at least 1; as many before them fill the trails.
        size: of the pictures, pixels.

    Raises:
        ValueError: a number is too small, or a size that :class:`SwarmView` refuses.
    """
    if count < 2 or number < 1:
        raise ValueError(f"drawing: {count} vehicles and {number} pictures are not allowed, at least 2 and 1")
    view = SwarmView([f"uav_{i}" for i in range(count)], size=size)
    states = list(frames(count, 2 * number))
    for frame in states[:number]:
        view.update(frame)
    view.draw()
    began = time.perf_counter()
    for frame in states[number:]:
        view.update(frame)
        view.draw()
    return number / (time.perf_counter() - began)
