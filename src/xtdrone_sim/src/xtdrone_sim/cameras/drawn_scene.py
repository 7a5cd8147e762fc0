"""A world, its vehicles and its actors as bodies of a renderer, drawn from a camera at one time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.fleet import Vehicle
from xtdrone_common.poses import OPTICAL_FRAME, Pose, compose
from xtdrone_sim.cameras.rendering import Picture, Renderer
from xtdrone_sim.cameras.sun_shadows import SunShadows, darken
from xtdrone_sim.rays.scene import ActorInScene, SceneAt
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.shapes.visual import Box, Mesh, Visual
from xtdrone_worlds.worlds import people_meshes
from xtdrone_worlds.worlds.sdf import SdfActor, SdfModel, SdfWorld
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import box_of

_GROUND = Box((2000.0, 2000.0, 0.1))
_GROUND_COLOUR = (0.45, 0.5, 0.4, 1.0)
_WIDE = 100.0  # m, sides from which on a model's shape counts as ground
_ROUGH = 0.5  # m, distance of its top from z = 0
_FLAT = 0.05  # m, height up to which a shape merges with ground at z = 0: far away, the renderer's depth is coarse
_TERRAIN = 20.0  # m, sides from which on a mesh counts as terrain, which may rise from z = 0
_LOWERED = -0.12  # m, ground below such shapes


@dataclass(frozen=True)
class View:
    """View of a camera.

    Attributes:
        link: Gazebo's name of its link.
        pinhole: its projection and image size.
        near, far: clipping distances, m.
        pose: pose of the camera in the link: x ahead, z up in the image.
        depth: whether depths are wanted as well.
    """

    link: str
    pinhole: Pinhole
    near: float
    far: float
    pose: Pose = field(default_factory=Pose)
    depth: bool = False


def ground_level(models: Sequence[SdfModel]) -> float | None:
    """Return the height of the level ground to be drawn below models, m; None if one of them is itself wide ground.

    The ground is drawn at z = 0, where it is in the physics, but a little lower under terrain and flat shapes, such as
    roads.

    Raises:
        SdfError: a mesh cannot be read.
    """
    level = 0.0
    for model in models:
        for link in model.links:
            for visual in link.visuals:
                pose = compose(compose(model.pose, link.pose), visual.pose)
                low, high = box_of(visual.geometry, pose)
                width, depth, _ = high - low
                if min(width, depth) >= _WIDE and abs(high[2]) <= _ROUGH:
                    return None
                is_terrain = isinstance(visual.geometry, Mesh) and min(width, depth) > _TERRAIN and abs(low[2]) <= _FLAT
                if is_terrain or (abs(high[2]) <= _FLAT and min(width, depth) > _FLAT):
                    level = _LOWERED
    return level


class DrawnScene:
    """Bodies for everything in a world.

    Attributes:
        actors: bodies of each actor's postures: the stance, then the frames of its walk.
        links: body by Gazebo's name of the link (model::link).
    """

    def __init__(
        self, renderer: Renderer, world: SdfWorld, fleet: Sequence[Vehicle] = (), *, shadows: bool = False
    ) -> None:
        """Add the world's models, the vehicles' links and the actors' postures.

        Models keep the world's poses until ``draw`` gets others; vehicles and actors are hidden until then.

        Args:
            renderer: receives the bodies; the caller closes it.
            world: the world to draw; one without ground of its own gets level ground, see ``ground_level``.
            fleet: vehicles, whose types are looked up by name.
            shadows: whether the sun casts shadows, if the world's light does.

        Raises:
            ValueError: an invalid mesh, texture, person or vehicle type; the text names it.
        """
        self.actors: dict[str, tuple[int, ...]] = {}
        self.links: dict[str, int] = {}
        self._homes: dict[str, tuple[int, Pose]] = {}  # body and first pose of the links in the world's file
        self._moved: set[str] = set()
        self._added: dict[str, SdfModel] = {}
        self._deleted: frozenset[str] = frozenset()
        self._renderer = renderer
        self._light = world.light
        self._shadows = SunShadows(world, fleet) if shadows and world.light.shadows else None
        self._shown: dict[str, int] = {}
        level = ground_level(world.models)
        if level is not None:
            middle = Pose((0.0, 0.0, level - 0.5 * _GROUND.size[2]))
            renderer.add([Visual(_GROUND, middle, _GROUND_COLOUR)])
        for model in world.models:
            poses = self._add_model(model)
            self._homes.update((name, (self.links[name], poses[name])) for name in poses.keys() & self.links.keys())
        types = {kind: load_vehicle(kind) for kind in dict.fromkeys(vehicle.model for vehicle in fleet)}
        for vehicle in fleet:
            for part in types[vehicle.model].urdf.moving:
                self._add_link(f"{vehicle.name}::{part.name}", part.visuals, None)
        skins = people_meshes.skins([actor.skin for actor in world.actors])
        for actor, skin in zip(world.actors, skins, strict=True):
            self._add_actor(actor, skin)

    def _add_model(self, model: SdfModel) -> dict[str, Pose]:
        """Add the links of a model; return their poses by Gazebo's names."""
        poses = {f"{model.name}::{link.name}": compose(model.pose, link.pose) for link in model.links}
        for (name, pose), link in zip(poses.items(), model.links, strict=True):
            self._add_link(name, link.visuals, pose)
        return poses

    def change(self, added: Sequence[SdfModel], deleted: Sequence[str]) -> None:
        """Change the models from those of the world's file.

        Args:
            added: all models that have been added since the start and still exist.
            deleted: names of all deleted models and actors of the file.

        Raises:
            ValueError: an invalid mesh or texture; the text names it.
        """
        if self._shadows is not None:
            self._shadows.change(added, deleted)
        wanted = {model.name: model for model in added}
        for name in [name for name, model in self._added.items() if wanted.get(name) != model]:
            for link in self._added.pop(name).links:
                body = self.links.pop(f"{name}::{link.name}", None)
                if body is not None:
                    self._renderer.hide(body)
        before, self._deleted = self._deleted, frozenset(deleted)
        for name, (body, pose) in self._homes.items():
            model_name = name.partition("::")[0]
            if model_name in self._deleted - before:
                self._renderer.hide(body)
                self.links.pop(name, None)
            elif model_name in before - self._deleted:
                self._renderer.place(body, pose)
                self.links[name] = body
        for name, model in wanted.items():
            if name not in self._added:
                self._added[name] = model
                self._add_model(model)

    def _add_link(self, name: str, visuals: Sequence[Visual], pose: Pose | None) -> None:
        if not visuals:
            return
        body = self.links[name] = self._renderer.add(visuals)
        if pose is None:
            self._renderer.hide(body)
        else:
            self._renderer.place(body, pose)

    def _add_actor(self, actor: SdfActor, skin: str) -> None:
        person = people_meshes.load(skin)
        bodies = tuple(self._renderer.add(posture) for posture in (person.standing, *person.walk))
        for body in bodies:
            self._renderer.hide(body)
        self.actors[actor.name] = bodies

    def draw(self, scene: SceneAt, view: View, labels: bool = False) -> Picture:
        """Return the image of a camera.

        Args:
            scene: poses of the moving objects; others keep their last poses.
            view: the camera; its link must be in ``scene``.
            labels: also fill the labels of the image, with bodies as in ``links`` and ``actors``.

        Raises:
            ValueError: the scene lacks the link.
        """
        if view.link not in scene.links:
            raise ValueError(f"camera's link: {view.link!r} is not in the scene; there are {', '.join(scene.links)}")
        for name, pose in scene.links.items():
            body = self.links.get(name)
            if body is not None:
                self._renderer.place(body, pose)
        self._put_back(scene)
        for name, state in scene.actors.items():
            self._place_actor(name, state)
        link = scene.links[view.link]
        camera = compose(link if view.pose == Pose() else compose(link, view.pose), OPTICAL_FRAME)
        depth = view.depth or self._shadows is not None
        picture = self._renderer.draw(view.pinhole, camera, view.near, view.far, self._light, labels, depth)
        if self._shadows is None or picture.depth is None:
            return picture
        reached = self._shadows.reached(scene, view.pinhole, camera, picture.depth)
        shaded = darken(picture.rgb, reached, self._light)
        return replace(picture, rgb=shaded, depth=picture.depth if view.depth else None)

    def _put_back(self, scene: SceneAt) -> None:
        """Return the world's models that a restart has restored, and hide deleted actors."""
        for name in self._moved - scene.links.keys():
            if name.partition("::")[0] not in self._deleted:
                self._renderer.place(*self._homes[name])
        self._moved = scene.links.keys() & self._homes.keys()
        for name in self._shown.keys() - scene.actors.keys():
            self._renderer.hide(self.actors[name][self._shown.pop(name)])

    def _place_actor(self, name: str, state: ActorInScene) -> None:
        bodies = self.actors.get(name)
        if bodies is None:
            return
        frames = len(bodies) - 1
        posture = 0 if state.phase < 0.0 or not frames else 1 + round(state.phase * frames) % frames
        shown = self._shown.get(name)
        if shown is not None and shown != posture:
            self._renderer.hide(bodies[shown])
        self._renderer.place(bodies[posture], state.pose)
        self._shown[name] = posture
