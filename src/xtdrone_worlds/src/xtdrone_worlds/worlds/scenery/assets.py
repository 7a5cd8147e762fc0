"""Meshes and textures of the scenery: names, files, and the program that generates the files.

``python -m xtdrone_worlds.worlds.scenery.assets`` regenerates all files, which are part of the package.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from xtdrone_worlds.data_files import data_path
from xtdrone_worlds.worlds.scenery import scenery_meshes, textures
from xtdrone_worlds.worlds.scenery.scenery_meshes import TexturedTriangles
from xtdrone_worlds.worlds.scenery.textures import Picture

FOLDER = data_path("models/scenery")

# generator, size in pixels, number of textures
_TEXTURES: dict[str, tuple[Callable[[int, np.random.Generator], Picture], int, int]] = {
    "grass": (textures.grass, 512, 6),
    "meadow": (textures.meadow, 512, 4),
    "crops": (textures.crops, 512, 6),
    "gravel": (textures.gravel, 256, 3),
    "asphalt": (textures.asphalt, 256, 3),
    "water": (textures.water, 256, 2),
    "leaves": (textures.leaves, 128, 3),
    "roof": (textures.roof, 128, 3),
    "wall": (textures.wall, 128, 1),
    "bricks": (textures.bricks, 128, 3),
    "wood": (textures.wood, 128, 3),
    "hay": (textures.hay, 128, 3),
    "stone": (textures.stone, 128, 3),
}

_SEDAN = [(-2.15, 0.32), (2.1, 0.32), (2.2, 0.6), (2.05, 0.82), (0.85, 0.95), (-1.5, 0.98), (-2.1, 0.92), (-2.2, 0.6)]
_HATCH = [(-1.8, 0.32), (1.75, 0.32), (1.85, 0.62), (1.7, 0.85), (0.85, 1.0), (-1.75, 1.02), (-1.85, 0.6)]
_VAN = [(-2.4, 0.38), (2.35, 0.38), (2.45, 0.8), (2.2, 1.1), (1.6, 1.25), (-2.4, 1.3)]
_PICKUP = [(-2.5, 0.45), (2.45, 0.45), (2.55, 0.75), (2.4, 1.0), (1.1, 1.08), (-2.5, 1.02)]
_CARS: dict[str, tuple[list[tuple[float, float]], list[tuple[float, float]], float]] = {
    "sedan": (_SEDAN, [(-1.5, 0.94), (0.95, 0.94), (0.3, 1.4), (-0.95, 1.42)], 1.74),
    "hatch": (_HATCH, [(-1.75, 0.98), (0.95, 0.98), (0.35, 1.45), (-1.5, 1.47)], 1.68),
    "van": (_VAN, [(-2.35, 1.25), (1.7, 1.25), (1.15, 1.95), (-2.3, 2.0)], 1.9),
    "pickup": (_PICKUP, [(-0.6, 1.04), (1.15, 1.04), (0.6, 1.6), (-0.5, 1.62)], 1.85),
}


def _car_body(name: str) -> TexturedTriangles:
    body, cabin, width = _CARS[name]
    (_, _), (_, _), (front, top), (rear, _) = cabin
    return scenery_meshes.join(
        scenery_meshes.prism(body, width),
        scenery_meshes.cuboid((rear + 0.05, -0.42 * width, top - 0.02), (front - 0.05, 0.42 * width, top + 0.06)),
    )


def _car_glass(name: str) -> TexturedTriangles:
    _, cabin, width = _CARS[name]
    return scenery_meshes.prism(cabin, 0.88 * width)


def _car_wheels(name: str) -> TexturedTriangles:
    body, _, width = _CARS[name]
    base = 0.62 * body[1][0]
    wheel = scenery_meshes.revolve([(0.33, -0.12), (0.33, 0.12)], 10)
    turned = TexturedTriangles(wheel.corners[:, :, [0, 2, 1]] * np.array([1.0, -1.0, 1.0]), wheel.texture)
    places = [(x, y, 0.33) for x in (-base, base) for y in (-0.44 * width, 0.44 * width)]
    return scenery_meshes.join(*(scenery_meshes.move(turned, place) for place in places))


def _gable(_rng: np.random.Generator) -> TexturedTriangles:
    return scenery_meshes.map_texture(scenery_meshes.prism([(-0.5, 0.0), (0.5, 0.0), (0.0, 1.0)], 1.0).corners, 0.5)


def _hip(_rng: np.random.Generator) -> TexturedTriangles:
    points = [(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0), (0, -0.25, 1), (0, 0.25, 1)]
    return scenery_meshes.polyhedron(points, [(3, 2, 1, 0), (0, 1, 4), (1, 2, 5, 4), (2, 3, 5), (3, 0, 4, 5)], 0.5)


_MESHES: dict[str, tuple[Callable[[np.random.Generator], TexturedTriangles], int]] = {
    "crown": (lambda rng: scenery_meshes.crown(int(rng.integers(3, 6)), rng), 6),
    "conifer": (lambda rng: scenery_meshes.conifer(int(rng.integers(3, 6)), rng), 4),
    "bush": (lambda rng: scenery_meshes.ball(2, 0.2, rng), 4),
    "rock": (lambda rng: scenery_meshes.ball(1, 0.28, rng), 4),
    "blob": (scenery_meshes.blob, 6),
    "path": (lambda rng: scenery_meshes.strip(24, 1.6, rng), 4),
    "road": (lambda rng: scenery_meshes.strip(32, 0.0, rng), 1),
    "ground": (lambda _: scenery_meshes.grid(4, 4), 1),
    "gable": (_gable, 1),
    "hip": (_hip, 1),
    "cone": (lambda _: scenery_meshes.revolve([(1.0, 0.0), (0.0, 1.0)], 14), 1),
    "triangle": (lambda _: scenery_meshes.prism([(-0.5, 0.0), (0.5, 0.0), (0.0, 0.866)], 1.0), 1),
    **{f"car_{name}_body": (lambda _, name=name: _car_body(name), 1) for name in _CARS},  # type: ignore[misc]
    **{f"car_{name}_glass": (lambda _, name=name: _car_glass(name), 1) for name in _CARS},  # type: ignore[misc]
    **{f"car_{name}_wheels": (lambda _, name=name: _car_wheels(name), 1) for name in _CARS},  # type: ignore[misc]
}

CARS = tuple(_CARS)


def texture(kind: str, number: int) -> Path:
    """Return the file of a texture."""
    return FOLDER / "textures" / f"{kind}_{number}.jpg"


def mesh(kind: str, number: int = 0) -> Path:
    """Return the file of a mesh."""
    return FOLDER / "meshes" / f"{kind}_{number}.obj"


def texture_count(kind: str) -> int:
    """Return the number of textures of a kind."""
    return _TEXTURES[kind][2]


def mesh_count(kind: str) -> int:
    """Return the number of meshes of a kind."""
    return _MESHES[kind][1]


def _random(name: str, number: int) -> np.random.Generator:
    return np.random.default_rng((zlib.crc32(name.encode()), number))


def write_all() -> None:
    """Write all meshes and textures."""
    for folder in ("meshes", "textures"):
        (FOLDER / folder).mkdir(parents=True, exist_ok=True)
    for name, (paint, size, count) in _TEXTURES.items():
        for number in range(count):
            picture = Image.fromarray(paint(size, _random(name, number)))
            picture.save(texture(name, number), quality=82, optimize=True)
    for name, (make, count) in _MESHES.items():
        for number in range(count):
            scenery_meshes.write_obj(make(_random(name, number)), mesh(name, number))


if __name__ == "__main__":
    write_all()
