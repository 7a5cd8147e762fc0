"""Seamless textures of ground, walls, leaves and wood from filtered noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Colour = tuple[float, float, float]


def noise(size: int, scales: dict[float, float], rng: np.random.Generator, stretch: float = 1.0) -> Array:
    """Return periodic noise, shape (size, size), mean 0, standard deviation 1.

    Args:
        size: pixels.
        scales: weight for each spot size, pixels.
        rng: random generator.
        stretch: ratio of the spots' length along the image's rows to that along the columns.
    """
    fy = np.fft.fftfreq(size)[:, None]
    fx = np.fft.rfftfreq(size)[None, :] * stretch
    square = fx * fx + fy * fy
    total = np.zeros((size, size))
    for spot, weight in scales.items():
        spectrum = np.fft.rfft2(rng.standard_normal((size, size))) * np.exp(-square * (np.pi * spot) ** 2 / 2.0)
        spectrum[0, 0] = 0.0
        layer = np.fft.irfft2(spectrum, (size, size))
        total += weight * layer / layer.std()
    return total / total.std()


def paint(value: Array, colours: list[Colour]) -> Array:
    """Map values to colours, from the first (-2) to the last (2); return shape (h, w, 3)."""
    at = np.clip((value + 2.0) / 4.0, 0.0, 1.0) * (len(colours) - 1)
    table = np.asarray(colours, float)
    return np.stack([np.interp(at, np.arange(len(colours)), table[:, k]) for k in range(3)], axis=2)


def finish(picture: Array) -> Picture:
    """Return an image as 8-bit values."""
    return np.clip(np.round(picture * 255.0), 0, 255).astype(np.uint8)


def _tint(colours: list[Colour], rng: np.random.Generator, by: float) -> list[Colour]:
    """Return the colours with a common random shift of brightness and hue."""
    factor = rng.uniform(1.0 - by, 1.0 + by, 3) * rng.uniform(1.0 - by, 1.0 + by)
    return [(r * factor[0], g * factor[1], b * factor[2]) for r, g, b in colours]


def grass(size: int, rng: np.random.Generator) -> Picture:
    """Return a lawn."""
    value = noise(size, {1.0: 0.7, 3.0: 0.5, 12.0: 0.5, 40.0: 0.35}, rng)
    return finish(
        paint(value, _tint([(0.16, 0.24, 0.08), (0.27, 0.38, 0.13), (0.36, 0.46, 0.19), (0.5, 0.55, 0.3)], rng, 0.12))
    )


def meadow(size: int, rng: np.random.Generator) -> Picture:
    """Return tall grass with flowers and dry spots."""
    value = noise(size, {1.0: 0.8, 4.0: 0.6, 20.0: 0.7}, rng)
    colours = [(0.2, 0.27, 0.09), (0.36, 0.42, 0.17), (0.5, 0.5, 0.24), (0.63, 0.58, 0.36)]
    picture = paint(value, _tint(colours, rng, 0.12))
    spots = noise(size, {1.2: 1.0}, rng) + 0.6 * noise(size, {30.0: 1.0}, rng)
    flower = np.array([(0.95, 0.9, 0.3), (0.92, 0.92, 0.9), (0.75, 0.3, 0.5)][rng.integers(3)])
    picture[spots > 3.4] = flower
    return finish(picture)


def crops(size: int, rng: np.random.Generator) -> Picture:
    """Return rows of crops along the image's rows."""
    rows = int(rng.integers(10, 22))
    across = np.sin(np.arange(size) * (2.0 * np.pi * rows / size))[:, None]
    value = 1.1 * across + 0.7 * noise(size, {1.5: 1.0, 6.0: 0.5}, rng, 3.0)
    green = [(0.32, 0.24, 0.15), (0.36, 0.36, 0.16), (0.3, 0.42, 0.15), (0.45, 0.55, 0.22)]
    ripe = [(0.5, 0.4, 0.22), (0.66, 0.54, 0.29), (0.76, 0.65, 0.38), (0.84, 0.75, 0.5)]
    bare = [(0.25, 0.17, 0.11), (0.35, 0.25, 0.17), (0.43, 0.32, 0.22), (0.5, 0.4, 0.29)]
    return finish(paint(value, _tint([green, ripe, bare][rng.integers(3)], rng, 0.1)))


def gravel(size: int, rng: np.random.Generator) -> Picture:
    """Return a dirt road's surface."""
    value = noise(size, {1.0: 1.0, 2.5: 0.7, 25.0: 0.5}, rng)
    return finish(
        paint(value, _tint([(0.36, 0.31, 0.25), (0.52, 0.46, 0.38), (0.62, 0.56, 0.48), (0.75, 0.7, 0.63)], rng, 0.1))
    )


def asphalt(size: int, rng: np.random.Generator) -> Picture:
    """Return a piece of road, 8 m long along the columns and as wide as the image is high, with a dashed line."""
    value = noise(size, {1.0: 0.9, 3.0: 0.4, 50.0: 0.5}, rng)
    picture = paint(
        value, _tint([(0.22, 0.22, 0.23), (0.31, 0.31, 0.32), (0.38, 0.38, 0.38), (0.47, 0.46, 0.45)], rng, 0.1)
    )
    thin = max(1, size // 80)
    worn = noise(size, {2.0: 1.0}, rng) > -1.2
    line = np.zeros((size, size), bool)
    line[size // 2 - thin : size // 2 + thin, size // 4 : 3 * size // 4] = True
    line[3 * thin : 5 * thin] = line[-5 * thin : -3 * thin] = True
    picture[line & worn] = (0.82, 0.82, 0.79)
    return finish(picture)


def leaves(size: int, rng: np.random.Generator) -> Picture:
    """Return foliage in light grey-green, to be multiplied with a colour."""
    value = noise(size, {2.0: 1.0, 6.0: 0.9}, rng)
    return finish(paint(value, [(0.35, 0.38, 0.33), (0.62, 0.66, 0.58), (0.85, 0.88, 0.78), (1.0, 1.0, 0.93)]))


def roof(size: int, rng: np.random.Generator) -> Picture:
    """Return rows of roof tiles in light grey, to be multiplied with a colour."""
    rows, columns = 8, 10
    y, x = np.mgrid[0:size, 0:size] / size
    shade = 0.75 + 0.25 * ((y * rows) % 1.0)
    shade *= 0.9 + 0.1 * np.abs(np.sin(np.pi * (x * columns + 0.5 * np.floor(y * rows))))
    tile = rng.uniform(0.85, 1.0, (rows, 2 * columns))
    shade *= tile[(y * rows).astype(int), (x * 2 * columns).astype(int)]
    shade += 0.03 * noise(size, {1.5: 1.0}, rng)
    return finish(np.repeat(shade[:, :, None], 3, axis=2))


def wall(size: int, rng: np.random.Generator) -> Picture:
    """Return plaster in light grey, to be multiplied with a colour."""
    value = 0.93 + 0.04 * noise(size, {1.5: 1.0, 20.0: 0.8}, rng)
    return finish(np.repeat(value[:, :, None], 3, axis=2))


def bricks(size: int, rng: np.random.Generator) -> Picture:
    """Return bricks and mortar."""
    rows, columns = 16, 6
    y, x = np.mgrid[0:size, 0:size] / size
    row = (y * rows).astype(int)
    along = x * columns + 0.5 * (row % 2)
    colour = rng.uniform(0.8, 1.1, (rows, columns))[row, along.astype(int) % columns]
    picture = colour[:, :, None] * np.array([0.6, 0.33, 0.26])
    mortar = ((y * rows) % 1.0 < 0.14) | (along % 1.0 < 0.06)
    picture[mortar] = (0.72, 0.69, 0.64)
    return finish(picture + 0.03 * noise(size, {1.2: 1.0}, rng)[:, :, None])


def wood(size: int, rng: np.random.Generator) -> Picture:
    """Return boards in light brown, to be multiplied with a colour."""
    boards = 6
    y = (np.arange(size) * boards // size)[:, None]
    value = 0.8 + 0.06 * noise(size, {2.0: 1.0, 5.0: 0.6}, rng, 12.0) + rng.uniform(-0.08, 0.08, boards)[y]
    value = np.where((np.arange(size) * boards % size < boards)[:, None], 0.35, value)
    return finish(value[:, :, None] * np.array([1.0, 0.86, 0.68]))


def hay(size: int, rng: np.random.Generator) -> Picture:
    """Return straw."""
    value = noise(size, {1.0: 1.0, 3.0: 0.6}, rng, 4.0)
    return finish(paint(value, [(0.42, 0.33, 0.15), (0.64, 0.53, 0.28), (0.78, 0.67, 0.4), (0.9, 0.82, 0.58)]))


def stone(size: int, rng: np.random.Generator) -> Picture:
    """Return rock in light grey, to be multiplied with a colour."""
    value = 0.75 + 0.12 * noise(size, {1.5: 0.7, 8.0: 0.8, 40.0: 0.6}, rng)
    return finish(np.repeat(value[:, :, None], 3, axis=2))


def water(size: int, rng: np.random.Generator) -> Picture:
    """Return the surface of a pond."""
    value = noise(size, {3.0: 0.6, 15.0: 1.0}, rng, 2.0)
    return finish(paint(value, [(0.13, 0.2, 0.22), (0.19, 0.28, 0.3), (0.25, 0.34, 0.36), (0.36, 0.45, 0.47)]))
