"""All models of a running simulation by name: their poses, and the changes that requests make to them."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np

from xtdrone_common.poses import Pose, compose, conjugate, inverse, rotate
from xtdrone_sim.gazebo.models_in_requests import check_model
from xtdrone_sim.gazebo.request_limits import MOST_ADDED, MOST_WRENCHES, RequestError, check_name, check_wrench, unknown
from xtdrone_sim.gazebo.states import STANDING, State, in_world, part_of
from xtdrone_sim.physics.bodies.movable_bodies import MOST_PAIRS, Drive
from xtdrone_sim.physics.vehicle_dynamics import LOST
from xtdrone_sim.physics.wrenches import Wrench
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.topics.actor_topics import ActorTopics
from xtdrone_sim.vehicles.link_poses import Links
from xtdrone_worlds.worlds.sdf import SdfJoint, SdfLink, SdfModel

Change = Callable[[], str]
"""A validated change: makes the change and returns a description of it."""

_WORLD = ("", "world", "map", "ground_plane", "ground_plane::link")


class Models:
    """The models of a simulation.

    A model's number is its index in the world file; then follow the numbers of the actors, then those of the models
    added by requests.

    Attributes:
        names: names by number; a list that only grows until a restart.
        deleted: numbers of deleted models and actors.
        added: numbers of the existing models that requests have added, with their descriptions.
        first_actor: number of the first actor, or the number of models in the world file.
        first_added: number of the first model that a request adds.
    """

    def __init__(self, simulation: Simulation, actors: ActorTopics) -> None:
        """Start with the world of the file.

        Args:
            simulation: vehicles and models.
            actors: people.
        """
        self._simulation = simulation
        self._actors = actors
        self.update_vehicles()
        self.names: list[str] = []
        self.restart()

    def restart(self) -> None:
        """Start again with the world of the file, after a restart of the simulation."""
        models = self._simulation.world.model.models
        self.first_actor = len(models)
        self.names[:] = [*(model.name for model in models), *self._actors.names]
        self.first_added = len(self.names)
        self.deleted: set[int] = set()
        self.added: dict[int, SdfModel] = {}
        self._numbers = {name: number for number, name in enumerate(self.names)}

    def update_vehicles(self) -> None:
        """Update the vehicles after one has joined or left."""
        names = self._simulation.names
        self._vehicles = {name: i for i, name in enumerate(names) if name}
        self._links = Links(names, self._simulation.models)

    # names

    @property
    def vehicle_count(self) -> int:
        """Number of vehicles in the world."""
        return len(self._vehicles)

    @property
    def present(self) -> list[str]:
        """Names of all models, in the order of /gazebo/model_states."""
        rest = [name for number, name in enumerate(self.names) if number not in self.deleted]
        return ["ground_plane", *self._vehicles, *rest]

    def vehicle(self, name: str) -> int | None:
        """Return the index of a vehicle; None if the name is not one."""
        return self._vehicles.get(name)

    def actor(self, name: str) -> int | None:
        """Return the index of an actor; None if the name is not one."""
        number = self._numbers.get(name)
        if number is None or not self.first_actor <= number < self.first_actor + len(self._actors.names):
            return None
        return number - self.first_actor

    def model(self, name: str) -> SdfModel | None:
        """Return the description of a model that is neither vehicle nor actor; None if the name is not one."""
        number = self._numbers.get(name)
        if number is None or self.actor(name) is not None:
            return None
        return self._description(number)

    def _description(self, number: int) -> SdfModel:
        return self.added[number] if number in self.added else self._simulation.world.model.models[number]

    # poses

    def find(self, what: str, name: str, *, frame: bool = False) -> State:
        """Return the state in the world of a model, or of a link by ``model::link``.

        Args:
            what: field of the request, for messages.
            name: name of the model or link; a vehicle's or a model's name is that of its body.
            frame: whether "", "world" and "map" are the world.

        Raises:
            RequestError: there is none of this name.
        """
        if name in (_WORLD if frame else _WORLD[-2:]):
            return STANDING
        link = self._links.find(name)
        if link is not None:
            return self._vehicle_link(link)
        base, part = self._split(name)
        actor = self.actor(base)
        if actor is not None and not part:
            return State(self._actors.pose(actor))
        model = self.model(base)
        if model is None:
            raise unknown(what, name, self._links.names if part else self.present)
        state = self._model_state(self._numbers[base])
        if not part:
            return state
        for one in model.links:
            if one.name == part:
                return part_of(state, one.pose)
        raise unknown(what, name, [f"{base}::{one.name}" for one in model.links])

    def _split(self, name: str) -> tuple[str, str]:
        """Return the names of model and link; a part beyond a joint is a model itself, such as ``door::leaf``."""
        if name in self._numbers:
            return name, ""
        base, _, part = name.rpartition("::")
        return (base, part) if base else (name, "")

    def find_link(self, what: str, name: str) -> State:
        """Return the state of a link, as ``find``, but of the first link for the name of a model."""
        model = self.model(name)
        return self.find(what, name if model is None or not model.links else f"{name}::{model.links[0].name}")

    def _vehicle_link(self, number: int) -> State:
        simulation = self._simulation
        records = self._links.place(
            simulation.world.plant, simulation.gimbals.records, simulation.landing_gears.records
        )
        record = records[number]
        (x, y, z), (w, i, j, k) = record["position"].tolist(), record["q"].tolist()
        return State(Pose((x, y, z), (w, i, j, k)), tuple(record["velocity"].tolist()), tuple(record["spin"].tolist()))

    def _model_state(self, number: int) -> State:
        body = self._simulation.world.bodies.by_number.get(number)
        if body is None:
            return State(self._simulation.world.model.models[number].pose)
        return State(body.pose, body.velocity, body.spin)

    def links(self, *, still: bool) -> list[tuple[str, State]]:
        """Return name and state of all links that are not of vehicles.

        Args:
            still: whether to include models that have never moved.
        """
        world = self._simulation.world
        numbers = range(self.first_actor) if still else []
        rows = [number for number in numbers if number not in self.deleted]
        rows = sorted({*rows, *world.bodies.models})
        out = []
        for number in rows:
            state, name = self._model_state(number), self.names[number]
            out += [(f"{name}::{link.name}", part_of(state, link.pose)) for link in self._description(number).links]
        return out

    def bodies(self) -> list[tuple[int, State]]:
        """Return number and state of all models that may have moved."""
        return [(number, self._model_state(number)) for number in self._simulation.world.bodies.models]

    # changes

    def moving(self, name: str, state: State, frame: str, *, hold_steps: int = 0) -> Change:
        """Return the change that moves a model to a state.

        Args:
            name: name of the model.
            state: state in ``frame``.
            frame: name of the frame.
            hold_steps: steps for which a model or disarmed vehicle is held there.

        Raises:
            RequestError: the model or the frame does not exist.
        """
        return self._placing(name, in_world(state, self.find("reference_frame", frame, frame=True)), hold_steps)

    def moving_link(self, name: str, state: State, frame: str) -> Change:
        """Return the change that moves a model so that one of its links is at ``state``, see ``moving``.

        Raises:
            RequestError: the link or the frame does not exist, or the link moves in its vehicle.
        """
        self.find("link_name", name)
        target = in_world(state, self.find("reference_frame", frame, frame=True))
        base, part = self._split(name)
        vehicle, model = self.vehicle(base), self.model(base)
        if vehicle is not None:
            root = self._simulation.models[vehicle].urdf.root
            if part not in ("", root):
                raise RequestError(f"link_name: {name!r} is moved by its joint; only {base}::{root} can be set")
            return self._placing(base, target)
        if model is None:
            raise RequestError(f"link_name: {name!r} has no links; set_model_state moves it")
        link = next((one for one in model.links if one.name == part), model.links[0])
        return self._placing(base, part_of(target, inverse(link.pose)))

    def _placing(self, name: str, state: State, hold_steps: int = 0) -> Change:
        vehicle, actor, number = self.vehicle(name), self.actor(name), self._numbers.get(name)
        x, y, z = state.pose.position
        words = f"{name} is moved to ({x:.2f}, {y:.2f}, {z:.2f}) m"
        if vehicle is not None:

            def place_vehicle() -> str:
                position, turn = state.pose.position, state.pose.orientation
                rates = rotate(conjugate(turn), state.spin)
                is_armed = bool(self._simulation.autopilot.setpoint["armed"][vehicle])
                held = 0 if is_armed else hold_steps
                self._simulation.world.place_vehicle(vehicle, position, turn, state.velocity, rates, held)
                return f"{words}; its estimator sees a jump" if is_armed else words

            return place_vehicle
        if actor is not None:

            def place_actor() -> str:
                self._actors.place(actor, state.pose)
                return words

            return place_actor
        if number is None:
            raise unknown("model_name", name, self.present[1:])
        parts = self._find_joined(number)
        if len(parts) > 1 or self._joints_of({name}):
            self._check_loose(name, parts)

        def targets() -> dict[int, State]:
            back = inverse(self._model_state(number).pose)
            return {part: part_of(state, compose(back, self._model_state(part).pose)) for part in parts}

        for part, one in targets().items():
            self._check_crowd(name, self._description(part), one.pose, part)

        def place_model() -> str:
            for part, one in targets().items():
                self._simulation.world.place_model(part, one.pose, one.velocity, one.spin, hold_steps)
            return words

        return place_model

    def _joints_of(self, names: Collection[str]) -> list[SdfJoint]:
        """Return the joints at models."""
        joints = self._simulation.world.model.joints
        return [joint for joint in joints if joint.parent in names or joint.child in names]

    def _find_joined(self, number: int) -> list[int]:
        """Return the numbers of a model and of those that joints connect to it."""
        names = {self.names[number]}
        if number < self.first_actor:
            count = 0
            while count < len(names):
                count = len(names)
                joints = self._joints_of(names)
                names |= {end for joint in joints for end in (joint.parent, joint.child) if end in self._numbers}
        return sorted(self._numbers[name] for name in names)

    def _check_loose(self, name: str, parts: Sequence[int]) -> None:
        """Reject moving models that a joint attaches to the world or to a static model."""
        for joint in self._joints_of({self.names[part] for part in parts}):
            for end in (joint.parent, joint.child):
                number = self._numbers.get(end)
                body = None if number is None else self._simulation.world.bodies.by_number.get(number)
                if body is None or not body.is_solid:
                    raise RequestError(
                        f"model_name: {name!r} is attached by its joint {joint.name!r}; it can be pushed"
                    )

    def adding(self, name: str, model: SdfModel, pose: Pose, frame: str) -> Change:
        """Return the change that adds a model.

        Args:
            name: its name.
            model: its description, whose own pose is relative to ``pose``.
            pose: pose in ``frame``.
            frame: name of the frame.

        Raises:
            RequestError: the name is not allowed or taken, the frame does not exist, or the model is not allowed.
        """
        check_name("model_name", name)
        if name in self.present:
            raise RequestError(f"model_name: {name!r} already exists; delete_model removes a model")
        if len(self.added) >= MOST_ADDED:
            raise RequestError(f"model_name: {name!r}: {MOST_ADDED} models have been added, no more are allowed")
        check_model(model)
        origin = compose(self.find("reference_frame", frame, frame=True).pose, pose)
        placed = replace(model, name=name, pose=compose(origin, model.pose))
        self._check_crowd(name, placed, placed.pose)

        def add() -> str:
            self.enter(placed)
            return f"{name} is added, {'a static model' if placed.static else 'a body that moves'}"

        return add

    def _check_crowd(self, name: str, model: SdfModel, pose: Pose, number: int | None = None) -> None:
        """Check the contacts of a model at a new pose; see ``Bodies.crowd``.

        Raises:
            RequestError: too many shapes would touch.
        """
        if self._simulation.world.bodies.crowd(model, pose, number) > MOST_PAIRS:
            raise RequestError(
                f"model_name: {name!r} would touch others that touch each other: more than {MOST_PAIRS} pairs of "
                "shapes in one crowd are not allowed"
            )

    def enter(self, model: SdfModel, drive: Drive | None = None) -> int:
        """Add a model at its pose under a free name, and return its number.

        Args:
            model: its description.
            drive: drive that moves it, see ``Bodies.add``; None: forces move it.

        Raises:
            SdfError: a mesh file cannot be read.
        """
        number = len(self.names)
        self._simulation.world.add_model(number, model, model.pose, drive)
        self.names.append(model.name)
        self._numbers[model.name] = number
        self.added[number] = model
        return number

    def deleting(self, name: str) -> Change:
        """Return the change that deletes a model or an actor.

        Raises:
            RequestError: there is no such model, or it is a vehicle or the ground.
        """
        if name == "ground_plane":
            raise RequestError("model_name: 'ground_plane' cannot be deleted, the ground always exists")
        if self.vehicle(name) is not None:
            raise RequestError(
                f"model_name: {name!r} is a vehicle with an autopilot; /simulator/remove_vehicle removes it"
            )
        number = self._numbers.get(name)
        if number is None:
            raise unknown("model_name", name, self.present)
        actor = self.actor(name)
        parts = self._find_joined(number) if actor is None else [number]

        def delete() -> str:
            for part in parts:
                if actor is None:
                    self._simulation.world.remove_model(part)
                else:
                    self._actors.remove(actor)
                self.deleted.add(part)
                self.added.pop(part, None)
                del self._numbers[self.names[part]]
            return f"{name} is deleted"

        return delete

    def pushing(self, name: str, frame: str, wrench: State, begin_us: int, end_us: int | None) -> Change:
        """Return the change that applies a wrench.

        Args:
            name: name of a body, ``model::link``.
            frame: name of the frame in whose axes the wrench is given, and in which its point is.
            wrench: ``pose.position`` is the point, m, ``velocity`` the force, N, ``spin`` the torque, N m.
            begin_us: simulated time of the start, microseconds; a time in the past means at once.
            end_us: simulated time of the end, counted from ``begin_us``; None: never.

        Raises:
            RequestError: the body or the frame does not exist, the body cannot move, or the wrench is too strong.
        """
        target, centre = self._find_pushed(name)
        axes = self.find("reference_frame", frame, frame=True)
        force = np.array(rotate(axes.pose.orientation, wrench.velocity))
        torque = np.array(rotate(axes.pose.orientation, wrench.spin))
        if frame not in _WORLD:
            point = np.array(compose(axes.pose, wrench.pose).position)
            torque = torque + np.cross(point - np.array(centre), force)
        world = self._simulation.world
        check_wrench(name, tuple(force.tolist()), tuple(torque.tolist()), *world.inertia(target))
        if len(world.wrenches) >= MOST_WRENCHES:
            raise RequestError(f"body_name: {name!r}: {MOST_WRENCHES} wrenches act or are to act, no more are allowed")

        def push() -> str:
            now_us, step_us = self._simulation.time_us, self._simulation.step_us
            begin = world.steps + max(begin_us - now_us, 0) / step_us
            end = float("inf") if end_us is None else begin + (end_us - begin_us) / step_us
            world.wrenches.add(Wrench(target, tuple(force.tolist()), tuple(torque.tolist()), begin, end))
            return f"a wrench acts on {name}"

        return push

    def releasing(self, name: str) -> Change:
        """Return the change that removes all wrenches of a body.

        Raises:
            RequestError: the body does not exist or cannot move.
        """
        target, _ = self._find_pushed(name)

        def release() -> str:
            return f"{self._simulation.world.wrenches.clear(target)} wrenches on {name} are removed"

        return release

    def setting_joints(self, name: str, joints: Sequence[str], positions: Sequence[float]) -> Change:
        """Return the change that sets joints of a vehicle, from whose positions their drives continue to move them.

        Args:
            name: name of the vehicle.
            joints: names of joints of its gimbal and landing gear, whose joints move together.
            positions: rad, as many as joints.

        Raises:
            RequestError: a joint cannot be set, or a position is outside its limits.
        """
        vehicle = self.vehicle(name)
        if vehicle is None:
            self.find("model_name", name)
            raise RequestError(f"model_name: {name!r} has no joints that can be set")
        if len(joints) != len(positions):
            raise RequestError(f"joint_positions: {len(positions)} are not allowed for {len(joints)} joint_names")
        turns = [self._joint_setting(vehicle, joint, value) for joint, value in zip(joints, positions, strict=True)]

        def set_joints() -> str:
            for turn in turns:
                turn()
            return f"joints of {name} are set: {', '.join(joints) or 'none'}"

        return set_joints

    def _joint_setting(self, vehicle: int, name: str, value: float) -> Callable[[], None]:
        model = self._simulation.models[vehicle]
        joints = list(model.gimbal.joints) if model.gimbal is not None else []
        settable = [*joints, *model.landing_gear]
        joint = next((one for one in settable if one.name == name), None)
        if joint is None:
            known = ", ".join(one.name for one in settable) or "none"
            raise RequestError(f"joint_names: {name!r} cannot be set; joints that can are {known}")
        if not (math.isfinite(value) and joint.lower <= value <= joint.upper):
            raise RequestError(f"{name}: {value:g} rad is not allowed, {joint.lower:g} to {joint.upper:g} rad")

        def turn() -> None:
            if joint in joints:
                number = joints.index(joint)
                assert model.gimbal is not None
                self._simulation.gimbals.records["joint"][vehicle, number] = model.gimbal.signs[number] * value
            else:
                self._simulation.landing_gears.records["raised"][vehicle] = value / joint.upper

        return turn

    def _find_pushed(self, name: str) -> tuple[int, Sequence[float]]:
        """Return the target of a wrench, see ``Wrench``, and its centre of mass in the world."""
        self.find("body_name", name)
        base, part = self._split(name)
        vehicle, world = self.vehicle(base), self._simulation.world
        if vehicle is not None:
            root = self._simulation.models[vehicle].urdf.root
            if part not in ("", root):
                raise RequestError(f"body_name: {name!r} is not a separate body, forces act on {base}::{root}")
            if world.plant["contact"][vehicle] >= LOST:
                raise RequestError(f"body_name: {name!r} is out of the world until it is reset")
            return vehicle, world.plant["position"][vehicle].tolist()
        number = self._numbers.get(base)
        body = None if number is None else world.bodies.models.get(number)
        if number is None or body is None or not body.is_solid:
            raise RequestError(f"body_name: {name!r} does not move, it is neither a vehicle nor a model with a mass")
        return len(world.plant) + number, body.centre

    def link(self, name: str) -> tuple[SdfModel, SdfLink] | None:
        """Return a link of a model with the model; None if there is none of this name."""
        base, part = self._split(name)
        model = self.model(base)
        links = () if model is None else model.links
        found = next((one for one in links if part in (one.name, "")), None)
        return None if model is None or found is None else (model, found)
