"""A world, its vehicles and its people, for rays.

Rays see the same as cameras: the opaque visuals of links (of a link without visuals its collision shapes), people in
the posture of their walk, and the ground, the plane z = 0, from above. Boxes, spheres and cylinders are exact.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.fleet import Vehicle
from xtdrone_common.poses import Pose, compose
from xtdrone_sim.rays.casting import PLACE, THING, cast_rays
from xtdrone_sim.rays.surfaces import of_triangles, surfaces_of, visible_shapes, visible_shapes_of
from xtdrone_sim.rays.tree import NOTHING, SURFACE, Trees, build, join_trees
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.worlds import people_meshes
from xtdrone_worlds.worlds.sdf import SdfActor, SdfModel


@dataclass(frozen=True)
class ActorInScene:
    """State of an actor.

    Attributes:
        pose: point between its feet, x ahead, world.
        phase: phase of its walk, cycles; negative: it stands.
    """

    pose: Pose
    phase: float = -1.0


@dataclass(frozen=True)
class SceneAt:
    """Poses of all moving objects at one time.

    Attributes:
        links: pose in the world by Gazebo's name of the link (model::link).
        actors: states by name.
    """

    links: Mapping[str, Pose]
    actors: Mapping[str, ActorInScene]


GROUND = "ground_plane"
MOST_TRIANGLES = 2_000_000
"""Largest number of surfaces of a scene, 0.3 GB."""

Array = NDArray[np.float64]


class SceneError(ValueError):
    """A scene in which rays cannot be cast; the message gives the reason."""


class Hits(NamedTuple):
    """Hits of rays.

    Attributes:
        ranges: (n,) distance, m; infinite without a hit, NaN for a ray whose origin or direction is not finite.
        owners: (n,) index of the hit model or vehicle in ``RayScene.owners``; -1: no hit.
        cosines: (n,) cosine of the angle between the ray and the surface's normal, 0..1.
    """

    ranges: Array
    owners: NDArray[np.int64]
    cosines: Array


class Layout(NamedTuple):
    """The arrays of a scene, which never change; see ``casting.cast_rays``."""

    trees: Trees
    things: NDArray[np.void]
    names: tuple[str, ...]
    roots: Mapping[str, tuple[int, ...]]


class RayScene:
    """Trees over everything in a world.

    Attributes:
        owners: names of all that rays can hit: the ground, the world's models, the vehicles, the actors, added models.
    """

    def __init__(
        self, models: Sequence[SdfModel], fleet: Sequence[Vehicle] = (), actors: Sequence[SdfActor] = ()
    ) -> None:
        """Build the trees. Vehicles and actors are absent until ``places`` gets their poses.

        Args:
            models: models of the world, at the poses of its file.
            fleet: vehicles, whose types are looked up by name.
            actors: people of the world.

        Raises:
            SceneError: too many triangles.
            ValueError: an invalid mesh, person or vehicle type; the text names it.
        """
        self.owners = [GROUND]
        self._numbers = {GROUND: 0}
        self._models = {model.name: model for model in models}
        self._surfaces = {model.name: self._place_surfaces(model) for model in models}
        self._homes = links_of(models)
        self._loose: set[str] = set()  # models of the file whose links have trees of their own
        self._deleted: frozenset[str] = frozenset()
        self._trees: dict[str, list[Trees]] = {}  # of each thing that moves, by the name of its link or actor
        self._parts: dict[tuple[str, str], NDArray[np.void]] = {}  # surfaces by vehicle type and link
        self._added: dict[str, SdfModel] = {}
        self._add_fleet(fleet)
        self._add_actors(actors)
        self._layout: Layout | None = None
        self._check_size()

    def number(self, owner: str) -> int:
        """Return the index of a name in ``owners``, to which a new name is appended."""
        if owner not in self._numbers:
            self._numbers[owner] = len(self.owners)
            self.owners.append(owner)
        return self._numbers[owner]

    def _place_surfaces(self, model: SdfModel) -> NDArray[np.void]:
        shapes = [(geometry, compose(model.pose, pose)) for geometry, pose in visible_shapes_of(model)]
        return surfaces_of(shapes, self.number(model.name))

    def _check_size(self) -> None:
        count = sum(map(len, self._surfaces.values()))
        count += sum(len(tree.surfaces) for trees in self._trees.values() for tree in trees)
        if count > MOST_TRIANGLES:
            largest = max(self._surfaces, key=lambda name: len(self._surfaces[name]), default="")
            raise SceneError(
                f"world: {count} triangles are too many for rays, at most {MOST_TRIANGLES} are allowed; "
                f"model {largest!r} has the most"
            )

    def _add_fleet(self, fleet: Sequence[Vehicle]) -> None:
        moving = {model: load_vehicle(model).urdf.moving for model in dict.fromkeys(vehicle.model for vehicle in fleet)}
        for vehicle in fleet:
            for link in moving[vehicle.model]:
                part = vehicle.model, link.name
                if part not in self._parts:
                    self._parts[part] = surfaces_of(visible_shapes(link.visuals, link.collisions), 0)
                if len(self._parts[part]):
                    self._trees[f"{vehicle.name}::{link.name}"] = [build(self._parts[part])]
            self.number(vehicle.name)

    def add_vehicle(self, vehicle: Vehicle) -> None:
        """Add a vehicle.

        Raises:
            SceneError: too many triangles; nothing has changed then.
            ValueError: an invalid mesh or vehicle type; nothing has changed then.
        """
        before = dict(self._trees)
        try:
            self._add_fleet([vehicle])
            self._check_size()
        except ValueError:
            self._trees = before
            raise
        self._layout = None

    def remove_vehicle(self, name: str) -> None:
        """Remove a vehicle."""
        self._trees = {link: trees for link, trees in self._trees.items() if link.partition("::")[0] != name}
        self._layout = None

    def _add_actors(self, actors: Sequence[SdfActor]) -> None:
        skins = people_meshes.skins([actor.skin for actor in actors])
        postures: dict[str, list[Trees]] = {}
        for actor, skin in zip(actors, skins, strict=True):
            if skin not in postures:
                body = people_meshes.read(skin)
                points = [body.posture(k)[body.triangles] for k in range(len(body.poses))]
                postures[skin] = [build(of_triangles(corners, 0)) for corners in points]
            self._trees[actor.name] = postures[skin]
            self.number(actor.name)

    def change(self, added: Sequence[SdfModel], deleted: Sequence[str]) -> None:
        """Change the models from those of the world's file.

        Args:
            added: all models that have been added since the start and still exist.
            deleted: names of all deleted models and actors of the file.

        Raises:
            SceneError: too many triangles.
            ValueError: an invalid mesh; the text names it.
        """
        wanted = {model.name: model for model in added}
        for name in [name for name, model in self._added.items() if wanted.get(name) != model]:
            self._forget(self._added.pop(name))
        for name, model in wanted.items():
            if name not in self._added:
                self._added[name] = model
                self._loosen(model)
        self._deleted = frozenset(deleted)
        self._layout = None
        self._check_size()

    def _loosen(self, model: SdfModel) -> None:
        for link in model.links:
            surfaces = surfaces_of(visible_shapes(link.visuals, link.collisions), 0)
            if len(surfaces):
                self._trees[f"{model.name}::{link.name}"] = [build(surfaces)]
        self.number(model.name)

    def _forget(self, model: SdfModel) -> None:
        for link in model.links:
            self._trees.pop(f"{model.name}::{link.name}", None)

    @property
    def layout(self) -> Layout:
        """The arrays for rays; a new object after each change of the scene."""
        if self._layout is None:
            self._layout = self._lay_out()
        return self._layout

    def _lay_out(self) -> Layout:
        standing = [surfaces for name, surfaces in self._surfaces.items() if name not in self._loose | self._deleted]
        fixed = build(np.concatenate(standing) if standing else np.zeros(0, SURFACE))
        shared: dict[int, int] = {}  # number in ``trees`` by id: actors and vehicles of a kind share theirs
        trees = [fixed]
        for own in self._trees.values():
            for tree in own:
                if id(tree) not in shared:
                    shared[id(tree)] = len(trees)
                    trees.append(tree)
        together, roots = join_trees(trees)
        things = np.zeros(1 + len(self._trees), THING)
        things["owner"][0], things["radius"][0] = NOTHING, math.inf
        for k, (name, own) in enumerate(self._trees.items(), start=1):
            things[k] = (self.number(name.partition("::")[0]), max(map(_radius, own)))
        named = {name: tuple(roots[shared[id(tree)]] for tree in own) for name, own in self._trees.items()}
        return Layout(together, things, tuple(self._trees), {"": (roots[0],), **named})

    def places(self, scene: SceneAt) -> NDArray[np.void]:
        """Return the places (m,) ``casting.PLACE`` of all objects at one time, for the current ``layout``.

        Models of the world's file whose links are in ``scene`` keep these poses from now on.
        """
        moved = {name.partition("::")[0] for name in scene.links.keys() - self._trees.keys()} & self._models.keys()
        for name in sorted(moved - self._loose):
            self._loose.add(name)
            self._loosen(self._models[name])
            self._layout = None
        layout = self.layout
        places = np.zeros(len(layout.things), PLACE)
        places["q"][:, 0] = 1.0
        places["root"] = NOTHING
        places["root"][0] = layout.roots[""][0]
        for k, name in enumerate(layout.names, start=1):
            roots, pose = layout.roots[name], scene.links.get(name, self._home(name))
            if pose is not None:
                places[k] = (roots[0], pose.position, pose.orientation)
            elif name in scene.actors:
                state = scene.actors[name]
                places[k] = (_posture(roots, state), state.pose.position, state.pose.orientation)
        return places

    def _home(self, name: str) -> Pose | None:
        """Return the place of a link of the world's file that a restart has restored."""
        return None if name.partition("::")[0] in self._deleted else self._homes.get(name)

    def cast(
        self, origins: Array, directions: Array, most: float, *, scene: SceneAt | None = None, skip: int = NOTHING
    ) -> Hits:
        """Return the hits of rays at one time; ``casting.cast_rays`` casts each at its own.

        Args:
            origins: (n, 3) m, map.
            directions: (n, 3), map, of any length but 0.
            most: largest range, m.
            scene: poses of all moving objects; None: the world alone.
            skip: index of an owner that rays pass through.
        """
        places = self.places(scene or SceneAt({}, {}))[None]
        n = len(origins)
        return cast(self.layout, places, np.zeros(n, np.int64), np.zeros(n), origins, directions, most, skip)


def cast(
    layout: Layout,
    places: NDArray[np.void],
    segments: NDArray[np.int64],
    shares: Array,
    origins: Array,
    directions: Array,
    most: float,
    skip: int = NOTHING,
) -> Hits:
    """Cast rays, each at its own time; see ``casting.cast_rays``."""
    n = len(origins)
    hits = Hits(np.empty(n), np.empty(n, np.int64), np.empty(n))
    cast_rays(*layout.trees, True, layout.things, places, segments, shares, skip, origins, directions, most, *hits)
    return hits


def links_of(models: Sequence[SdfModel]) -> dict[str, Pose]:
    """Return the poses of the models' links by Gazebo's names, as in ``SceneAt.links``."""
    return {f"{model.name}::{link.name}": compose(model.pose, link.pose) for model in models for link in model.links}


def _radius(tree: Trees) -> float:
    if not len(tree.nodes):
        return 0.0
    corners = np.maximum(np.abs(tree.nodes["low"][0]), np.abs(tree.nodes["high"][0]))
    return float(np.linalg.norm(corners))


def _posture(roots: tuple[int, ...], state: ActorInScene) -> int:
    frames = len(roots) - 1
    return roots[0 if state.phase < 0.0 or not frames else 1 + round(state.phase * frames) % frames]
