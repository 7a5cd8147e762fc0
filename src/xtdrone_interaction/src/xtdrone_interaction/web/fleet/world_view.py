"""The surroundings for the page: ground, models and people of the running world."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import rospy
from xtdrone_msgs.msg import SceneModels

from xtdrone_common.geodesy.projection import Datum
from xtdrone_common.poses import Pose
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch
from xtdrone_interaction.web.fleet.shapes_for_page import ShapeStore, describe_vehicle
from xtdrone_interaction.web.server.methods import CallError, Method, Params, needed
from xtdrone_interaction.web.server.session import Session
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.descriptions import ModelError
from xtdrone_worlds.worlds import people_meshes
from xtdrone_worlds.worlds.sdf import SdfModel, SdfWorld, load_world_file, read_world

log = logging.getLogger("xtdrone.web")


class WorldView:
    """Describes the world's file, including the changes that the simulator publishes."""

    def __init__(self, context: StationContext, fleet: FleetWatch) -> None:
        self._context = context
        self._fleet = fleet
        self._store = ShapeStore()
        self._worlds: dict[str, SdfWorld] = {}
        self._changes: SceneModels | None = None
        rospy.Subscriber("/xtdrone/models", SceneModels, self._on_models, queue_size=1)

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [
            Method("world.describe", self._describe),
            Method("world.vehicle", self._vehicle),
            Method("world.mesh", self._mesh),
            Method("world.texture", self._texture),
        ]

    def datum(self) -> Datum | None:
        """Return the origin of the map frame; None without a world. It blocks."""
        name = str(rospy.get_param("/xtdrone/world", ""))
        try:
            return self._world(name).datum if name else None
        except (ModelError, OSError, ValueError):
            return None

    def _on_models(self, message: SceneModels) -> None:
        self._changes = message
        self._context.in_loop(self._context.push_all, "world.changed", {})

    async def _describe(self, _session: Session, _params: Params) -> dict[str, Any]:
        return await self._context.blocking(self._read)

    async def _vehicle(self, _session: Session, params: Params) -> dict[str, Any]:
        known = [vehicle.model for vehicle in self._fleet.roster.vehicles]
        model = needed(params, "model", str, f"one of {', '.join(sorted(set(known)))}")
        if model not in known:
            raise CallError(f"model: {model[:80]!r} is not allowed, one of {', '.join(sorted(set(known)))}")
        return await self._context.blocking(lambda: describe_vehicle(load_vehicle(model), self._store))

    async def _mesh(self, _session: Session, params: Params) -> dict[str, str]:
        return await self._context.blocking(self._store.mesh, params.get("number"))

    async def _texture(self, _session: Session, params: Params) -> str:
        return await self._context.blocking(self._store.texture, params.get("number"))

    def _read(self) -> dict[str, Any]:
        """Return light, models and people; a world that cannot be read is empty, with the reason."""
        name = str(rospy.get_param("/xtdrone/world", ""))  # the simplified simulator has none
        described: dict[str, Any] = {"name": Path(name).stem, "models": [], "people": [], "trouble": ""}
        if not name:
            return described
        try:
            world = self._world(name)
            models = self._present(world, name)
            skins = people_meshes.skins([actor.skin for actor in world.actors])
            described["models"] = [self._model(model) for model in models]
            described["people"] = [
                self._person(actor.name, actor.pose, skin) for actor, skin in zip(world.actors, skins, strict=True)
            ]
            described["sky"] = list(world.light.background)
            described["datum"] = [world.datum.latitude, world.datum.longitude, world.datum.altitude]
        except (ModelError, OSError, ValueError) as error:
            log.warning("world %s is not shown: %s", name, error)
            described["trouble"] = str(error)
        return described

    def _world(self, name: str) -> SdfWorld:
        if name not in self._worlds:
            self._worlds = {name: load_world_file(name)}
        return self._worlds[name]

    def _present(self, world: SdfWorld, name: str) -> list[SdfModel]:
        """Return the models of the file that are still there, and those that have been added."""
        changes = self._changes
        if changes is None:
            return list(world.models)
        added = read_world(changes.sdf, Path(name)).models
        gone = {*changes.deleted, *(model.name for model in added)}
        return [*(model for model in world.models if model.name not in gone), *added]

    def _model(self, model: SdfModel) -> dict[str, Any]:
        shapes = [self._store.describe(visual, link.pose) for link in model.links for visual in link.visuals]
        return {"name": model.name, "pose": _numbers(model.pose), "shapes": shapes}

    def _person(self, name: str, pose: Pose, skin: str) -> dict[str, Any]:
        standing = people_meshes.load(skin).standing
        return {"name": name, "pose": _numbers(pose), "shapes": [self._store.describe(v, Pose()) for v in standing]}


def _numbers(pose: Pose) -> list[float]:
    return [*pose.position, *pose.orientation]
