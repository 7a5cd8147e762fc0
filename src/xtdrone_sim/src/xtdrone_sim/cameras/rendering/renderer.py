"""Renderer for scenes of bodies with visuals, seen by pinhole cameras."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.frames import to_xyzw
from xtdrone_common.poses import Pose
from xtdrone_common.settings import check_range
from xtdrone_sim.cameras.rendering.backends import BACKENDS, Backend, RendererError
from xtdrone_sim.cameras.rendering.depth_ranges import Extents
from xtdrone_sim.physics.quiet_pybullet import pybullet
from xtdrone_worlds.shapes.triangles import Triangles, joined, rotation_matrix, triangles_of, write_obj
from xtdrone_worlds.shapes.visual import Colour, Geometry, Visual
from xtdrone_worlds.worlds.sdf import Light

__all__ = ["BACKENDS", "Light", "Picture", "Renderer", "RendererError"]

_TILE = (1024, 768)  # pixels; largest image that the EGL plugin draws in one call
_OUT_OF_SIGHT = (0.0, 0.0, -1e7)
_MASK = (1 << 24) - 1  # bits of a label with the body; the upper ones contain the link
_SKY = 1.0 - 2e-7  # depth buffer value of empty pixels; TinyRenderer's is off by its rounding
_INDEX_LIMIT = 120_000  # maximum number of corners in a pybullet mesh


@dataclass(frozen=True)
class Picture:
    """The image of a camera.

    Attributes:
        rgb: colours, shape (height, width, 3), uint8.
        labels: body at each pixel or -1, shape (height, width), int32; None if not requested.
        depth: distance along the optical axis, m, infinite where nothing is, (height, width); None if not requested.
    """

    rgb: NDArray[np.uint8]
    labels: NDArray[np.int32] | None
    depth: NDArray[np.float32] | None = None


class Renderer:
    """A scene to be drawn.

    Attributes:
        backend: "egl" or "tiny".
    """

    def __init__(self, backend: str = "auto") -> None:
        """Create an empty scene.

        Args:
            backend: "egl", "tiny", or "auto": EGL if available, otherwise TinyRenderer, with a log message.

        Raises:
            ValueError: unknown backend.
            RendererError: EGL is requested but not available, or in use by another renderer of this process.
        """
        self._backend = Backend(backend)
        self.backend = self._backend.name
        self._client = self._backend.client
        self._folder = tempfile.TemporaryDirectory(prefix="xtdrone-rendering-")
        self._parts: list[list[int]] = []  # pybullet bodies of each body
        self._label_of = np.full(1, -1, np.int32)  # body by pybullet body, and -1 at the end for none
        self._triangles: dict[Geometry, Triangles] = {}
        self._files: dict[object, tuple[Path, ...]] = {}
        self._textures: dict[Path, int] = {}
        self._all_parts: list[int] = []
        self._shapes: dict[Path, int] = {}  # file to shape number, in order of first use
        self._places: list[Pose | None] = []
        self._points: dict[tuple[Path, ...], NDArray[np.float64]] = {}  # corners of the triangles, by files
        self._extents = Extents()

    def add(self, visuals: Iterable[Visual]) -> int:
        """Add a body at the origin and return its number.

        Raises:
            MeshError: a mesh cannot be read.
            ValueError: invalid colour, texture or pose; the message names it.
        """
        groups: dict[tuple[Colour, Path | None], list[Visual]] = {}
        for visual in visuals:
            for value in visual.colour:
                check_range("colour", value, 0.0, 1.0)
            groups.setdefault((visual.colour, visual.texture), []).append(visual)
        made = [
            (
                colour,
                None if texture is None else self._texture(texture),
                self._meshes(tuple((visual.geometry, visual.pose) for visual in group), texture),
            )
            for (colour, texture), group in groups.items()
        ]
        body = len(self._parts)
        parts = [self._part(file, colour, picture) for colour, picture, files in made for file in files]
        self._parts.append(parts)
        self._places.append(Pose())
        self._extents.add(np.concatenate([np.empty((0, 3, 3)), *(self._points[files] for _, _, files in made)]))
        if parts:
            grown = np.full(max(parts) + 2, -1, np.int32)
            grown[: len(self._label_of) - 1] = self._label_of[:-1]
            grown[parts] = body
            self._label_of = grown
        return body

    def _part(self, file: Path, colour: Colour, picture: int | None) -> int:
        """Create a pybullet body, one mesh of one colour and texture, and return its number."""
        shape = self._client.createVisualShape(
            pybullet.GEOM_MESH, fileName=str(file), rgbaColor=colour, specularColor=(0.0, 0.0, 0.0)
        )
        part = self._client.createMultiBody(0.0, -1, shape)
        self._all_parts.append(part)
        number = self._shapes.setdefault(file, len(self._shapes))
        if picture is not None:
            # The EGL plugin uses a part's number as that of its shape, which parts of one file share.
            bearer = self._all_parts[number] if self.backend == "egl" else part
            self._client.changeVisualShape(bearer, -1, textureUniqueId=picture)
        return part

    def _texture(self, path: Path) -> int:
        if path not in self._textures:
            if not path.is_file():
                raise ValueError(f"texture: there is no file {path}")
            number = self._client.loadTexture(str(path))
            if number < 0:
                raise ValueError(f"texture: {path} cannot be read, must be PNG or JPEG")
            self._textures[path] = number
        return self._textures[path]

    def _meshes(self, shapes: tuple[tuple[Geometry, Pose], ...], texture: Path | None) -> tuple[Path, ...]:
        """Return files that combine all posed shapes into one mesh, or as few as pybullet supports.

        Files are separate for each texture: with EGL, bodies of one file share their texture.
        """
        key = (shapes, texture)
        if key not in self._files:
            parts = []
            for geometry, pose in shapes:
                if geometry not in self._triangles:
                    self._triangles[geometry] = triangles_of(geometry)
                parts.append(self._triangles[geometry].placed(pose))
            whole = joined(parts)
            files = []
            for begin in range(0, len(whole.points), _INDEX_LIMIT // 3):
                some = slice(begin, begin + _INDEX_LIMIT // 3)
                file = Path(self._folder.name) / f"{len(self._files)}_{begin}.obj"
                write_obj(file, Triangles(whole.points[some], whole.normals[some], whole.uv[some]))
                files.append(file)
            self._files[key] = tuple(files)
            self._points[self._files[key]] = whole.points
        return self._files[key]

    def _parts_of(self, body: int) -> list[int]:
        if not 0 <= body < len(self._parts):
            raise KeyError(f"body {body!r} does not exist")
        return self._parts[body]

    def place(self, body: int, pose: Pose) -> None:
        """Set the pose of a body, and show it if it was hidden.

        Raises:
            KeyError: unknown body.
            ValueError: the orientation is not of length 1, or the position is not finite.
        """
        parts = self._parts_of(body)
        if self._places[body] == pose:
            return
        rotation_matrix(pose)
        if not np.all(np.isfinite(pose.position)):
            raise ValueError(f"position: {pose.position!r} is not allowed, finite numbers")
        self._places[body] = pose
        self._extents.place(body, pose)
        for part in parts:
            self._client.resetBasePositionAndOrientation(part, pose.position, to_xyzw(pose.orientation))

    def hide(self, body: int) -> None:
        """Hide a body until it is placed again.

        Raises:
            KeyError: unknown body.
        """
        parts = self._parts_of(body)
        if self._places[body] is None:
            return
        self._places[body] = None
        self._extents.place(body, None)
        for part in parts:
            self._client.resetBasePositionAndOrientation(part, _OUT_OF_SIGHT, (0.0, 0.0, 0.0, 1.0))

    def draw(
        self,
        pinhole: Pinhole,
        pose: Pose,
        near: float = 0.1,
        far: float = 300.0,
        light: Light | None = None,
        labels: bool = False,
        depth: bool = False,
    ) -> Picture:
        """Draw the view of a camera.

        Args:
            pinhole: projection.
            pose: pose of the optical frame in the world: x right, y down, z ahead.
            near, far: limits of the visible depth, m.
            light: sun and sky; None: the defaults of ``Light``.
            labels: whether to return labels too.
            depth: whether to return depths too; with EGL they have the resolution of its depth buffer of 16 bits.

        Raises:
            ValueError: invalid limits, projection or pose.
        """
        check_range("near", near, 1e-3, 1e3, "m")
        check_range("far", far, near * 1.001, 1e6, "m")
        check_range("picture's width", pinhole.width, 1, 8192, "px")
        check_range("picture's height", pinhole.height, 1, 8192, "px")
        view = _view_matrix(pose)
        light = Light() if light is None else light
        picture = Picture(
            np.empty((pinhole.height, pinhole.width, 3), np.uint8),
            np.empty((pinhole.height, pinhole.width), np.int32) if labels else None,
            np.empty((pinhole.height, pinhole.width), np.float32) if depth else None,
        )
        ranges = self._extents.ranges(pinhole, pose, near, far) if self.backend == "egl" else [(near, far)]
        step = _TILE if self.backend == "egl" else (pinhole.width, pinhole.height)
        for top in range(0, pinhole.height, step[1]):
            for left in range(0, pinhole.width, step[0]):
                tile = Pinhole(
                    min(step[0], pinhole.width - left),
                    min(step[1], pinhole.height - top),
                    pinhole.fx,
                    pinhole.fy,
                    pinhole.cx - left,
                    pinhole.cy - top,
                )
                for number, limits in enumerate(ranges):
                    self._draw_tile(picture, (top, left), tile, view, limits, light, over=number > 0)
        return picture

    def _draw_tile(
        self,
        picture: Picture,
        corner: tuple[int, int],
        tile: Pinhole,
        view: list[float],
        limits: tuple[float, float],
        light: Light,
        over: bool,
    ) -> None:
        """Draw a tile of the image, optionally over its current content."""
        if self.backend == "tiny":  # it samples the corners of pixels instead of their centres
            tile = Pinhole(tile.width, tile.height, tile.fx, tile.fy, tile.cx - 0.5, tile.cy + 0.5)
        towards = -np.asarray(light.direction, float)
        _, _, rgb, depth, segments = self._backend.picture(
            tile.width,
            tile.height,
            viewMatrix=view,
            projectionMatrix=_projection_matrix(tile, *limits),
            lightDirection=towards.tolist(),
            lightColor=(1.0, 1.0, 1.0),
            lightAmbientCoeff=0.75,
            lightDiffuseCoeff=0.25,
            lightSpecularCoeff=0.0,
            shadow=0,
            flags=0 if picture.labels is not None else pybullet.ER_NO_SEGMENTATION_MASK,
        )
        size = (tile.height, tile.width)
        rows, columns = slice(corner[0], corner[0] + size[0]), slice(corner[1], corner[1] + size[1])
        colours = np.asarray(rgb, np.uint8).reshape(*size, 4)[:, :, :3]
        buffer = np.asarray(depth).reshape(size)
        nothing = buffer >= _SKY
        if picture.depth is not None:
            near, far = limits
            metres = np.where(nothing, np.inf, near * far / (far - buffer * (far - near)))
            np.copyto(picture.depth[rows, columns], metres, where=~nothing | (not over), casting="same_kind")
        shade = np.minimum(1.0, np.add(light.ambient, light.diffuse))
        if np.any(shade < 1.0):
            table = np.round(np.arange(256)[:, None] * shade).astype(np.uint8)
            colours = np.stack([table[:, k][colours[:, :, k]] for k in range(3)], axis=2)
        if not over:
            sky = np.round(255.0 * np.asarray(light.background)).astype(np.uint8)
            picture.rgb[rows, columns] = np.where(nothing[:, :, None], sky, colours)
        else:
            np.copyto(picture.rgb[rows, columns], colours, where=~nothing[:, :, None])
        if picture.labels is not None:
            seen = np.asarray(segments).reshape(size)
            found = self._label_of[np.where(nothing | (seen < 0), -1, seen & _MASK)]
            np.copyto(picture.labels[rows, columns], found, where=~nothing | (not over))

    def close(self) -> None:
        """Shut down the renderer; drawing is no longer possible."""
        self._backend.close()
        self._folder.cleanup()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _view_matrix(pose: Pose) -> list[float]:
    """Return OpenGL's view matrix of an optical frame, column by column, with y and z inverted."""
    turn = rotation_matrix(pose)
    if not np.all(np.isfinite(pose.position)):
        raise ValueError(f"position: {pose.position!r} is not allowed, finite numbers")
    into = np.diag([1.0, -1.0, -1.0]) @ turn.T
    view = np.eye(4)
    view[:3, :3] = into
    view[:3, 3] = -into @ np.asarray(pose.position, float)
    return view.T.ravel().tolist()


def _projection_matrix(pinhole: Pinhole, near: float, far: float) -> list[float]:
    """Return OpenGL's projection matrix of a pinhole, column by column."""
    w, h = pinhole.width, pinhole.height
    matrix = np.array(
        [
            [2.0 * pinhole.fx / w, 0.0, 1.0 - 2.0 * pinhole.cx / w, 0.0],
            [0.0, 2.0 * pinhole.fy / h, 2.0 * pinhole.cy / h - 1.0, 0.0],
            [0.0, 0.0, -(far + near) / (far - near), -2.0 * far * near / (far - near)],
            [0.0, 0.0, -1.0, 0.0],
        ]
    )
    return matrix.T.ravel().tolist()
