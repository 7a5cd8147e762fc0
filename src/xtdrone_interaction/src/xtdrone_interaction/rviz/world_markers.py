"""Markers of a world's models and people for rviz, without a ROS node.

=========  ==================  =========================================================
namespace  type                what it shows
=========  ==================  =========================================================
world      cube, ..., mesh     the shapes of the models, in their colours and textures
people     mesh                each person, standing or walking
=========  ==================  =========================================================

A marker is sent only when it is new or has moved; rviz keeps the others.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from geometry_msgs.msg import Point, Quaternion, Vector3
from geometry_msgs.msg import Pose as PoseMessage
from PIL import Image
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from xtdrone_common.poses import Pose, compose
from xtdrone_worlds.data_files import cached_folder
from xtdrone_worlds.shapes.triangles import triangles_of, write_obj
from xtdrone_worlds.shapes.visual import Box, Colour, Cylinder, Geometry, Mesh, Sphere, Visual
from xtdrone_worlds.worlds import people_meshes
from xtdrone_worlds.worlds.people_meshes import Person
from xtdrone_worlds.worlds.sdf import SdfModel, SdfWorld

MODELS, PEOPLE = "world", "people"
_STANDS = 0.02  # m between two updates; a person that moves less counts as standing
_JUMP = 2.0  # m between two updates; a person that moves more has been teleported
_BRIGHTER = 1.6  # of models' textures: rviz's light comes from the viewer, so the ground is dark
_FORMAT = "1"  # of the cached meshes; a new version invalidates them
_OWN_COLOURS = ColorRGBA(0.0, 0.0, 0.0, 0.0)  # use those of the mesh file

Key = tuple[str, int]


@dataclass
class _Walker:
    """A person: last position, and phase of the walk cycle; negative: standing."""

    person: Person
    number: int
    pose: Pose
    way: float = 0.0
    phase: float = -1.0


class WorldMarkers:
    """Collects the poses of models and people, and creates the markers of those that have changed."""

    def __init__(self, world: SdfWorld) -> None:
        """Start with all models and people at their poses in the world file.

        Raises:
            ValueError: a person's skin is unknown.
            OSError: the user's cache cannot be written.
        """
        self._numbers = itertools.count()
        self._file = {model.name: model for model in world.models}
        self._models: dict[str, SdfModel] = dict(self._file)
        self._ids = {name: self._new_ids(model) for name, model in self._models.items()}
        skins = people_meshes.skins([actor.skin for actor in world.actors])
        self._people = {
            actor.name: _Walker(people_meshes.load(skin), number, actor.pose)
            for number, (actor, skin) in enumerate(zip(world.actors, skins, strict=True))
        }
        self._poses = {model.name: model.pose for model in world.models}
        self._gone: set[str] = set()
        self._sent: dict[str, object] = {}  # markers shown by rviz, by model and person
        self._removed: list[Key] = []

    @property
    def has_models(self) -> bool:
        """Whether the world currently has models."""
        return bool(self._models)

    def restart(self) -> None:
        """Send all markers again, for a new subscriber or after all have been removed."""
        self._sent.clear()
        self._removed.clear()

    def on_models(self, added: Sequence[SdfModel], deleted: Sequence[str]) -> None:
        """Store the models added since the start, and the names of removed models of the file."""
        wanted = {name: model for name, model in self._file.items() if name not in deleted}
        wanted |= {model.name: model for model in added}
        for name, model in list(self._models.items()):
            if wanted.get(name) != model:
                self._removed += [(MODELS, number) for number in self._ids.pop(name)]
                self._sent.pop(name, None)
                del self._models[name]
        for name, model in wanted.items():
            if name not in self._models:
                self._models[name], self._ids[name], self._poses[name] = model, self._new_ids(model), model.pose
        self._gone = set(deleted) & self._people.keys()

    def on_poses(self, poses: Mapping[str, Pose]) -> None:
        """Store the poses of models and people by name, world frame; other names are ignored."""
        for name in poses.keys() & self._models.keys():
            self._poses[name] = poses[name]
        for name in poses.keys() & self._people.keys():
            _walk(self._people[name], poses[name])

    def changes(self, header: Header) -> list[Marker]:
        """Return the markers that differ from what has been sent, with a header of the map's frame."""
        made = [Marker(ns=ns, id=number, action=Marker.DELETE) for ns, number in self._removed]
        self._removed.clear()
        for name, model in self._models.items():
            if self._sent.get(name) != self._poses[name]:
                self._sent[name] = self._poses[name]
                made += self._of_model(replace(model, pose=self._poses[name]))
        for name, walker in self._people.items():
            shown = None if name in self._gone else (walker.pose, walker.phase)
            if self._sent.get(name) != shown:
                self._sent[name] = shown
                made.append(_person(walker) if shown else Marker(ns=PEOPLE, id=walker.number, action=Marker.DELETE))
        for marker in made:
            marker.header = header
        return made

    def _new_ids(self, model: SdfModel) -> list[int]:
        return [next(self._numbers) for link in model.links for _ in link.visuals]

    def _of_model(self, model: SdfModel) -> Iterator[Marker]:
        numbers = iter(self._ids[model.name])
        for link in model.links:
            for visual in link.visuals:
                yield visual_marker(MODELS, next(numbers), visual, compose(model.pose, link.pose))


def _walk(walker: _Walker, pose: Pose) -> None:
    """Move a person; the phase of the walk follows from the distance walked."""
    step = math.dist(walker.pose.position[:2], pose.position[:2])
    if pose == walker.pose:
        return
    walker.pose = pose
    if _STANDS < step < _JUMP:
        walker.way += step
        frames = max(1, len(walker.person.walk))
        walker.phase = round(walker.way / walker.person.stride * frames) % frames / frames
    else:
        walker.phase = -1.0


def _person(walker: _Walker) -> Marker:
    (body,) = walker.person.posture(walker.phase)
    return visual_marker(PEOPLE, walker.number, body, walker.pose)


def visual_marker(namespace: str, number: int, visual: Visual, parent: Pose) -> Marker:
    """Return the marker of a shape.

    Args:
        namespace, number: of the marker.
        visual: the shape.
        parent: pose of its link, world frame.
    """
    pose, shape = compose(parent, visual.pose), visual.geometry
    marker = Marker(ns=namespace, id=number, action=Marker.ADD, pose=_message(pose), color=ColorRGBA(*visual.colour))
    if visual.texture is not None:
        marker.type, marker.scale = Marker.MESH_RESOURCE, _scale(shape)
        brighter = 1.0 if namespace == PEOPLE else _BRIGHTER
        marker.mesh_resource = f"file://{_textured(shape, visual.texture, visual.colour, brighter)}"
        marker.mesh_use_embedded_materials, marker.color = True, _OWN_COLOURS
    elif isinstance(shape, Mesh):
        marker.type, marker.scale = Marker.MESH_RESOURCE, _scale(shape)
        marker.mesh_resource = f"file://{shape.path}"
    elif isinstance(shape, Box):
        marker.type, marker.scale = Marker.CUBE, Vector3(*shape.size)
    elif isinstance(shape, Cylinder):
        marker.type, marker.scale = Marker.CYLINDER, Vector3(2.0 * shape.radius, 2.0 * shape.radius, shape.length)
    elif isinstance(shape, Sphere):
        marker.type, marker.scale = Marker.SPHERE, Vector3(*[2.0 * shape.radius] * 3)
    return marker


def _message(pose: Pose) -> PoseMessage:
    w, x, y, z = pose.orientation
    return PoseMessage(Point(*pose.position), Quaternion(x, y, z, w))


def _scale(shape: Geometry) -> Vector3:
    return Vector3(*(shape.scale if isinstance(shape, Mesh) else (1.0, 1.0, 1.0)))


def _textured(shape: Geometry, texture: Path, colour: Colour, brighter: float) -> Path:
    """Return a Wavefront file with texture and colour, in the user's cache: rviz reads textures only from such files.

    Raises:
        MeshError, OSError: a file cannot be read, or the cache cannot be written.
    """
    content = shape.path.read_bytes() if isinstance(shape, Mesh) else repr(shape).encode()
    look = " ".join(f"{value:.3f}" for value in colour[:3])
    digest = hashlib.sha256(f"{_FORMAT} {brighter} {look} ".encode() + content + texture.read_bytes()).hexdigest()[:24]

    def write(folder: Path) -> None:
        if not isinstance(shape, Mesh):
            write_obj(folder / "shape.obj", triangles_of(shape))
        plain = content if isinstance(shape, Mesh) else (folder / "shape.obj").read_bytes()
        own = (b"mtllib", b"usemtl")
        lines = [line for line in plain.splitlines(keepends=True) if not line.startswith(own)]
        (folder / "mesh.obj").write_bytes(b"mtllib mesh.mtl\nusemtl look\n" + b"".join(lines))
        (folder / "mesh.mtl").write_text(f"newmtl look\nKa {look}\nKd {look}\nmap_Kd look.png\n", encoding="utf-8")
        with Image.open(texture) as picture:
            lit = picture.convert("RGB").point([min(255, round(brighter * value)) for value in range(256)] * 3)
            lit.save(folder / "look.png")

    return cached_folder("rviz", digest, write) / "mesh.obj"
