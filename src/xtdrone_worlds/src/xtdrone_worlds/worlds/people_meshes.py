"""People: textured bodies that stand and walk.

``models/people/<name>.npz`` holds a body at rest, its skin weights and the joints' transforms in a stance and in the
frames of one walk cycle; ``<name>.png`` its skin and clothes. ``load`` makes Wavefront files of these postures, once,
in a cache folder. ``training/people`` makes the bodies.

Frame of a person: origin on the ground between the feet (below the pelvis while walking), x ahead, y left, z up, m.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xtdrone_common.settings import check_choice
from xtdrone_worlds.data_files import cached_folder, data_path
from xtdrone_worlds.shapes.visual import Mesh, Visual

SPLITS = ("train", "test")
_FORMAT = b"1"  # of the cached files; a new version invalidates them


@dataclass(frozen=True)
class Body:
    """A person's surface and its postures.

    Attributes:
        height: m, without shoes, hair and hat.
        stride: distance of one walk cycle (two steps), m.
        split: "train" or "test"; the latter is reserved for the evaluation of detectors.
        vertices: (V, 3), at rest, m.
        triangles: (T, 3), counter-clockwise from outside.
        texture_points: (P, 2), 0..1 from the image's lower left corner.
        texture_triangles: (T, 3), the corners' texture points.
        weights: (V, 4), shares of ``joints``; rows sum to 1.
        joints: (V, 4), indices of the joints that move a vertex.
        poses: (1 + frames, J, 3, 4), transforms p -> R p + t of positions at rest: the stance, then the walk.
    """

    height: float
    stride: float
    split: str
    vertices: np.ndarray
    triangles: np.ndarray
    texture_points: np.ndarray
    texture_triangles: np.ndarray
    weights: np.ndarray
    joints: np.ndarray
    poses: np.ndarray

    def posture(self, pose: int) -> np.ndarray:
        """Return the vertices in a posture (0 stance, 1.. walk), (V, 3), m, by linear blend skinning."""
        mixed = np.einsum("vk,vkij->vij", self.weights, self.poses[pose][self.joints])
        return np.einsum("vij,vj->vi", mixed[..., :3], self.vertices) + mixed[..., 3]


@dataclass(frozen=True)
class Person:
    """A person as drawn.

    Attributes:
        name: as in ``names()``.
        height: m, without shoes, hair and hat.
        stride: length of one walk cycle (two steps), m.
        standing: shapes of the stance.
        walk: shapes of the frames of one walk cycle, evenly spaced; the left heel strikes at the first one.
    """

    name: str
    height: float
    stride: float
    standing: tuple[Visual, ...]
    walk: tuple[tuple[Visual, ...], ...]

    def posture(self, phase: float) -> tuple[Visual, ...]:
        """Return the shapes at a phase of the walk, cycles; negative: standing."""
        return self.standing if phase < 0.0 else self.walk[round(phase * len(self.walk)) % len(self.walk)]


def models_folder() -> Path:
    """Return the folder with the people's bodies and textures."""
    return data_path("models/people")


def names(split: str | None = None) -> list[str]:
    """Return the names of all people, sorted; ``split`` "train" or "test" selects those of one split.

    Raises:
        ValueError: the split is unknown.
    """
    known = sorted(path.stem for path in models_folder().glob("*.npz"))
    if split is None:
        return known
    check_choice("split", split, SPLITS)
    return [name for name in known if read(name).split == split]


def skins(wanted: Sequence[str]) -> list[str]:
    """Return the skin of each of several actors: the requested one, or for an empty name all people in rotation.

    Raises:
        ValueError: a name is unknown.
    """
    known = names() if wanted else []
    for name in wanted:
        if name:
            check_choice("skin", name, tuple(known))
    return [name or known[number % len(known)] for number, name in enumerate(wanted)]


def read(name: str) -> Body:
    """Read the body of a person.

    Raises:
        ValueError: the name is unknown.
    """
    path = models_folder() / f"{name}.npz"
    if not path.is_file():
        raise ValueError(f"person: {name!r} is not known, there are {', '.join(names())}")
    return read_file(path)


def read_file(path: Path) -> Body:
    """Read a body from a .npz file.

    Raises:
        OSError: the file cannot be read.
    """
    with np.load(path) as data:
        return Body(
            height=float(data["height"]),
            stride=float(data["stride"]),
            split=str(data["split"]),
            vertices=data["vertices"] * 1e-4,
            triangles=data["triangles"].astype(int),
            texture_points=data["texture_points"] / 65535.0,
            texture_triangles=data["texture_triangles"].astype(int),
            weights=data["weights"] / 255.0,
            joints=data["joints"].astype(int),
            poses=data["poses"].astype(float),
        )


def load(name: str) -> Person:
    """Return a person; creates its files in the user's cache folder if they are missing.

    Several processes may call this concurrently.

    Raises:
        ValueError: the name is unknown.
        OSError: the cache folder (``$XDG_CACHE_HOME``, else ``~/.cache``) cannot be written.
    """
    body = read(name)
    folder = _cache(name, body)
    texture = models_folder() / f"{name}.png"
    postures = [
        (Visual(Mesh(folder / _file(pose)), colour=(1.0, 1.0, 1.0, 1.0), texture=texture),)
        for pose in range(len(body.poses))
    ]
    return Person(name, body.height, body.stride, postures[0], tuple(postures[1:]))


def _file(pose: int) -> str:
    return f"walk_{pose - 1:02d}.obj" if pose else "standing.obj"


def _cache(name: str, body: Body) -> Path:
    """Return the folder with a person's Wavefront files."""
    digest = hashlib.sha256(_FORMAT + (models_folder() / f"{name}.npz").read_bytes()).hexdigest()[:16]

    def write(folder: Path) -> None:
        for pose in range(len(body.poses)):
            (folder / _file(pose)).write_text(wavefront(body, pose))

    return cached_folder("people", f"{name}-{digest}", write)


def wavefront(body: Body, pose: int) -> str:
    """Return a posture as the text of a Wavefront file, with normals and texture points."""
    points = body.posture(pose)
    lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in points.tolist()]
    lines += [f"vt {u:.5f} {v:.5f}" for u, v in body.texture_points.tolist()]
    lines += [f"vn {x:.3f} {y:.3f} {z:.3f}" for x, y, z in _normals(points, body.triangles).tolist()]
    corners = zip((body.triangles + 1).tolist(), (body.texture_triangles + 1).tolist(), strict=True)
    lines += ["f " + " ".join(f"{v}/{t}/{v}" for v, t in zip(face, uv, strict=True)) for face, uv in corners]
    return "\n".join(lines) + "\n"


def _normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return unit normals of the vertices, (V, 3)."""
    corners = points[triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out = np.zeros_like(points)
    for corner in range(3):
        np.add.at(out, triangles[:, corner], faces)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
