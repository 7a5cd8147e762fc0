"""Shadows of the sun in an image: rays from the surface at each pixel towards the sun.

The renderers' own shadows cover a small part of a world. These shadows are computed by rays (``rays.scene``): models,
vehicles and people cast them, at any distance up to ``_REACH``. A pixel in shadow keeps only the skylight.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.fleet import Vehicle
from xtdrone_common.poses import Pose
from xtdrone_sim.rays.scene import RayScene, SceneAt
from xtdrone_worlds.shapes.triangles import rotation_matrix
from xtdrone_worlds.worlds.sdf import Light, SdfModel, SdfWorld

_REACH = 300.0  # m from the camera to a surface, and from there to the object that casts a shadow
_OFF = 0.03  # m from a surface at which its ray begins
_COARSE = 1.5e-5  # 1/m: error of a depth over its square, of EGL's depth buffer of 16 bits from 2 m on, twice


class SunShadows:
    """The shadows of a world."""

    def __init__(self, world: SdfWorld, fleet: Sequence[Vehicle]) -> None:
        """Build the scene for rays.

        Raises:
            SceneError: too many triangles.
        """
        self._rays = RayScene(world.models, fleet, world.actors)
        self._towards = -np.asarray(world.light.direction, float)

    def change(self, added: Sequence[SdfModel], deleted: Sequence[str]) -> None:
        """Change the models; see ``RayScene.change``."""
        self._rays.change(added, deleted)

    def reached(self, scene: SceneAt, pinhole: Pinhole, camera: Pose, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return a mask (height, width) of the pixels that the sun reaches; the sky is always reached.

        Args:
            scene: poses of all moving objects.
            pinhole: projection.
            camera: pose of the optical frame in the world.
            depth: along the optical axis, (height, width), m; infinite for the sky.
        """
        rows, columns = np.nonzero(depth < _REACH)
        far = depth[rows, columns].astype(float)
        off = _OFF + _COARSE * far * far  # towards the camera as well, because visible surfaces face it
        seen = pinhole.rays(np.column_stack([columns + 0.5, rows + 0.5])) * (far - off)[:, None]
        points = seen @ rotation_matrix(camera).T + camera.position
        unit = self._towards / np.linalg.norm(self._towards)
        origins = points + off[:, None] * unit
        hits = self._rays.cast(origins, np.tile(unit, (len(origins), 1)), _REACH, scene=scene)
        reached = np.ones(depth.shape, bool)
        reached[rows, columns] = np.isinf(hits.ranges)
        return reached


def darken(rgb: NDArray[np.uint8], reached: NDArray[np.bool_], light: Light) -> NDArray[np.uint8]:
    """Return an image in which pixels that the sun does not reach have only the skylight.

    Args:
        rgb: image with sun and sky everywhere, (height, width, 3).
        reached: see ``SunShadows.reached``.
        light: sun and sky.
    """
    sky = np.minimum(1.0, light.ambient)
    share = sky / np.maximum(np.minimum(1.0, np.add(light.ambient, light.diffuse)), 1e-9)
    table = np.round(np.arange(256)[:, None] * share).astype(np.uint8)
    out = rgb.copy()
    shadow = ~reached
    for channel in range(3):
        out[shadow, channel] = table[rgb[shadow, channel], channel]
    return out
