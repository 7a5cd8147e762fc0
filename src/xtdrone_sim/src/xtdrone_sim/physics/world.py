"""The physical world: free flight integrated by a kernel, contacts by Bullet, in one ``step``.

A vehicle far from the ground, from obstacles and from all other vehicles is integrated by
``vehicle_dynamics.integrate_free``; near them Bullet integrates it under the same wrench. A vehicle at rest with
its motors off sleeps. Gravity is off in Bullet: weight is part of the wrench, so parked bodies stay in place. Models
that can move are in ``movable_bodies``.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.fleet import StartPose
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import Quaternion, Vector
from xtdrone_sim.effects import Effects, drive_rotors, integrate_all
from xtdrone_sim.physics import vehicle_dynamics as dynamics
from xtdrone_sim.physics import wrenches
from xtdrone_sim.physics.bodies.movable_bodies import Bodies, Drive
from xtdrone_sim.physics.bodies.obstacles import Obstacles
from xtdrone_sim.physics.contacts.bullet_contacts import Contact, contact_points, create_ground, create_vehicle
from xtdrone_sim.physics.contacts.contact_states import (
    CHECK_STEPS,
    FAR,
    NEAR,
    REST_SPEED,
    let_sleep,
    mark_near,
    sort_contacts,
    stay_free,
)
from xtdrone_sim.physics.contacts.start_collisions import body_pose, check_starts
from xtdrone_sim.physics.joints import ModelJoint, swap_ends
from xtdrone_sim.physics.quiet_pybullet import connect, pybullet
from xtdrone_sim.physics.vehicle_dynamics import ABSENT, ASLEEP, FARTHEST, FASTEST_TURN, LEAVING, LOST, PLANT, TOUCHING
from xtdrone_sim.vehicles.vehicle_model import MODEL, VehicleModel
from xtdrone_worlds.worlds.sdf import SdfModel, SdfWorld

_NO_BODY = -1  # of an absent place


def _absent_record() -> np.void:
    """Return the record of a place without a vehicle."""
    record = np.zeros(1, PLANT)[0]
    record["q"][0], record["contact"] = 1.0, ABSENT
    return record  # type: ignore[no-any-return]


class World:
    """All bodies of the world and their motion.

    Attributes:
        plant: (n,) ``PLANT``, true state of the vehicles; places without a vehicle are ABSENT.
        models: (n,) ``MODEL``.
        time_step: s.
        bodies: movable models, by number.
        wrenches: forces and torques by request.
        magnetic_field: (3,) gauss, ENU.
        lost: vehicles taken out of the world because their state was impossible; emptied by its reader.
        collisions: pairs that have collided since the start, lower index first: vehicles, and from n on the models by
            number: those of the world in its order, then added ones.
    """

    def __init__(
        self,
        model: SdfWorld,
        vehicles: Sequence[VehicleModel],
        poses: Sequence[StartPose],
        time_step: float,
        effects: Effects | None = None,
        absent: Collection[int] = (),
    ) -> None:
        """Place the vehicles.

        Args:
            model: the world.
            vehicles: one model per vehicle.
            poses: start pose of each vehicle.
            time_step: s.
            absent: indices of places without a vehicle; see ``add_vehicle``.
            effects: further forces and torques; their ``begin`` is called with ``plant`` before the first step.
        """
        count = len(vehicles)
        self.model = model
        self._effects = effects
        self.time_step = time_step
        self.plant = np.zeros(count, PLANT)
        self.models = np.zeros(count, MODEL)
        self.collisions: set[tuple[int, int]] = set()
        self.lost: list[int] = []
        for i, vehicle in enumerate(vehicles):
            self.models[i] = vehicle.record
        for v, m, pose in zip(self.plant, self.models, poses, strict=True):
            v["position"], v["q"] = body_pose(pose, float(m["box"][2]))
        self.magnetic_field = np.array(model.magnetic_field)
        self.set_wind(model.wind)
        self.plant["contact"] = TOUCHING
        for i in absent:
            self.plant[i] = _absent_record()
        self._wanted = self.plant["contact"].copy()
        self._steps = 0
        self._checked = -1  # step before which the contact states have been updated
        self._fixed = {number: one for number, one in enumerate(model.models) if one.static}
        self._obstacles = Obstacles(self._fixed)
        self._near_obstacles = 0
        self._held: dict[int, int] = {}  # vehicle to the step until which it is held
        self._limits = np.array([NEAR, FAR])
        self._bullet = connect()
        self.bodies = Bodies(self._bullet, model.friction, model.restitution)
        self.wrenches = wrenches.Wrenches()
        self._load_bullet()
        self._update_touching()

    def _load_bullet(self) -> None:
        client = self._bullet
        client.setTimeStep(self.time_step)
        client.setGravity(0.0, 0.0, 0.0)
        self._ground = create_ground(client, self.model)
        self._bodies = [
            _NO_BODY if v["contact"] == ABSENT else create_vehicle(client, self.model, v, m)
            for v, m in zip(self.plant, self.models, strict=True)
        ]
        self._index_of = {body: i for i, body in enumerate(self._bodies) if body != _NO_BODY}
        owners = self._obstacles.load(client, self.model.friction, self.model.restitution)
        self._index_of.update((body, len(self._bodies) + owner) for body, owner in owners.items())
        for number, model in enumerate(self.model.models):
            if not model.static:
                self.add_model(number, model, model.pose)
        self._join_models()

    def _join_models(self) -> None:
        numbers = {model.name: number for number, model in enumerate(self.model.models)}
        bodies = self.bodies.by_number
        self.joints: dict[str, ModelJoint] = {}
        for one in self.model.joints:
            parent, child = (bodies.get(numbers.get(end, -1)) for end in (one.parent, one.child))
            if child is not None:
                self.joints[one.name] = ModelJoint(self._bullet, one, parent, child)
            elif parent is not None:
                self.joints[one.name] = ModelJoint(self._bullet, swap_ends(one), None, parent)
        self._tie()
        self.bodies.before_removal = self._disconnect

    def _tie(self) -> None:
        """Make bodies that joints connect wake and sleep together."""
        number_of = {id(body): number for number, body in self.bodies.by_number.items()}
        group = {number: frozenset([number]) for number in number_of.values()}
        for joint in self.joints.values():
            ends = [number_of[id(body)] for body in (joint.parent, joint.child) if body is not None]
            union = frozenset().union(*(group[end] for end in ends))
            group |= dict.fromkeys(union, union)
        joined = {number_of[id(joint.child)] for joint in self.joints.values()}
        self.bodies.tied = {number: union for number, union in group.items() if union & joined}

    def _disconnect(self, number: int) -> None:
        """Remove the joints of a body."""
        body = self.bodies.by_number[number]
        gone = [name for name, joint in self.joints.items() if body is joint.parent or body is joint.child]
        for name in gone:
            self.joints.pop(name).remove()
        if gone:
            self._tie()

    def set_wind(self, velocity: Sequence[float] | NDArray[np.float64]) -> None:
        """Set the wind at all vehicles, m/s, ENU, and at those that join later."""
        self._wind = np.array(velocity, float)
        self.plant["wind"] = self._wind

    def check_starts(self, names: Sequence[str], which: Sequence[int] | None = None) -> None:
        """Check that the vehicles' places are free; see ``start_collisions.check_starts``.

        Raises:
            StartError: a vehicle would start below the ground, in an obstacle or in another vehicle.
        """
        owners = [model.name for model in self.model.models]
        check_starts(self.plant, self.models, names, self._obstacles, owners, which)

    def put(self, i: int, pose: StartPose, names: Sequence[str]) -> None:
        """Move vehicle ``i`` to a start pose, at rest, with its rotors stopped and without wrenches.

        A lost one is in the world again.

        Args:
            i: index of the vehicle.
            pose: its new pose.
            names: names of all vehicles; those with an empty name are absent.

        Raises:
            StartError: the place is not free; nothing has changed then.
        """
        self.plant[i] = self._start(i, pose, self.models, names)
        self.wrenches.clear(i)
        self._hand_over(i)
        self._update_touching()
        self.collisions = {pair for pair in self.collisions if i not in pair}

    def _start(self, i: int, pose: StartPose, models: NDArray[np.void], names: Sequence[str]) -> np.void:
        """Return the plant record of vehicle ``i`` at a start pose.

        Raises:
            StartError: the place is not free.
        """
        plant = self.plant.copy()
        plant[i] = np.zeros(1, PLANT)[0]
        v: np.void = plant[i]
        v["position"], v["q"] = body_pose(pose, float(models[i]["box"][2]))
        v["wind"], v["contact"] = self._wind, TOUCHING
        owners = [model.name for model in self.model.models]
        check_starts(plant, models, names, self._obstacles, owners, [i])
        return v

    def add_vehicle(self, i: int, vehicle: VehicleModel, pose: StartPose, names: Sequence[str]) -> None:
        """Add a vehicle at an absent place, at rest.

        Args:
            i: index of the place.
            vehicle: its model.
            pose: its start pose.
            names: names of all vehicles, its own included; those of absent places are empty.

        Raises:
            StartError: the pose is not free; nothing has changed then.
        """
        models = self.models.copy()
        models[i] = vehicle.record
        self.plant[i] = self._start(i, pose, models, names)
        self.models[i] = vehicle.record
        self._restore_body(i)
        self._update_touching()

    def _restore_body(self, i: int) -> None:
        """Create Bullet's body of vehicle ``i``, which has none."""
        self._bodies[i] = create_vehicle(self._bullet, self.model, self.plant[i], self.models[i])
        self._index_of[self._bodies[i]] = i

    def remove_vehicle(self, i: int) -> None:
        """Remove a vehicle from the world; bodies that rest against it wake."""
        v, m = self.plant[i].copy(), self.models[i]
        self._remove_body(i)
        self.collisions = {pair for pair in self.collisions if i not in pair}
        self.plant[i] = _absent_record()
        distances = np.linalg.norm(self.plant["position"] - v["position"], axis=1)
        near = distances < self.models["radius"] + m["radius"] + NEAR
        for j in np.flatnonzero(near & (self.plant["contact"] == ASLEEP)).tolist():
            self._touch(j)
        reach = float(m["radius"])
        self.bodies.wake_around(np.concatenate([v["position"] - reach, v["position"] + reach])[None])
        self._update_touching()

    def _remove_body(self, i: int) -> None:
        """Remove Bullet's body of vehicle ``i``, with its wrenches."""
        if self._bodies[i] != _NO_BODY:
            self._bullet.removeBody(self._bodies[i])
            del self._index_of[self._bodies[i]]
            self._bodies[i] = _NO_BODY
        self._held.pop(i, None)
        self.wrenches.clear(i)

    def _update_touching(self) -> None:
        self._touching = np.flatnonzero(self.plant["contact"] == TOUCHING).tolist()

    def step(self, actuators: NDArray[np.float64], armed: NDArray[np.int32]) -> None:
        """Advance the world by one time step under motor commands (n, MAX_ROTORS), 0..1, and armed flags (n,)."""
        self.check_contacts(armed)
        self._steps += 1
        gravity, dt = self.model.gravity, self.time_step
        if self._effects is None and not self.wrenches:
            touching = dynamics.step_all(self.plant, self.models, actuators, armed, gravity, dt)
        else:
            active = self.wrenches.active(self._steps - 1)
            self._wake_for(active)
            drive_rotors(self.plant, self.models, actuators, armed, dt)
            if self._effects is not None:
                self._effects.apply(armed)
            wrenches.apply(active, self.plant, self.bodies)
            touching = integrate_all(self.plant, self.models, armed, gravity, dt)
        if touching or self.bodies.awake:
            self._step_bullet()

    def _wake_for(self, active: list[tuple[wrenches.Wrench, float]]) -> None:
        """Wake the targets of the wrenches of the next step."""
        count = len(self.plant)
        for wrench, _ in active:
            number = wrench.target - count
            if number >= 0:
                body = self.bodies.by_number.get(number)
                if body is not None and body.is_solid and not body.held:
                    self.bodies.wake(number)
            elif wrench.target not in self._held:
                self.plant["still_steps"][wrench.target] = 0
                if self.plant["contact"][wrench.target] == ASLEEP:
                    self._touch(wrench.target)

    def check_contacts(self, armed: NDArray[np.int32]) -> int:
        """Update the contact states if that is due before the next step, as ``step`` does.

        Args:
            armed: (n,) non-zero when motors run.

        Returns:
            The number of steps until the next update.
        """
        done = self._steps % CHECK_STEPS
        if done == 0 and self._checked != self._steps:
            self._checked = self._steps
            self._sort_contacts(armed)
        return CHECK_STEPS - done

    def steps_apart(self, most: int) -> int:
        """Return ``most`` (steps, 0.1 s at most) if certainly no vehicle touches anything until then, else 0."""
        free = not self.has_obstacles and stay_free(self.plant, self.models, most, self.model.gravity, self.time_step)
        return most if free else 0

    @property
    def has_obstacles(self) -> bool:
        """Whether the vehicles can touch models of the world, or some are held."""
        return self._obstacles.count > 0 or bool(self.bodies.by_number) or bool(self._held)

    @property
    def standing(self) -> Collection[int]:
        """Numbers of the models that have never moved from their poses in the world's file."""
        return self._fixed.keys()

    @property
    def is_busy(self) -> bool:
        """Whether every step must be done by ``step``: a model moves, or a wrench acts or is to act."""
        return bool(self.bodies.awake) or bool(self.wrenches)

    @property
    def steps(self) -> int:
        """Number of steps since the start."""
        return self._steps

    def count_steps(self, steps: int) -> None:
        """Count steps in which other code has advanced ``plant``, with the contact checks between them."""
        self._steps += steps

    def _sort_contacts(self, armed: NDArray[np.int32]) -> None:
        if not self._count_changed_contacts(armed):
            return
        contact = self.plant["contact"]
        for i in np.flatnonzero(self._wanted != contact):
            if self._wanted[i] == TOUCHING:
                self._hand_over(i)
            elif self._wanted[i] == LOST:
                self._remove_body(int(i))
                self.lost.append(int(i))
            else:
                self._park(i, asleep=bool(self._wanted[i] == ASLEEP))
        contact[:] = self._wanted
        self._update_touching()

    def _count_changed_contacts(self, armed: NDArray[np.int32]) -> int:
        """Fill ``_wanted`` with the contact state of each vehicle; return the number of changes."""
        plant, models, wanted = self.plant, self.models, self._wanted
        if not self.has_obstacles:
            return int(sort_contacts(plant, models, armed, CHECK_STEPS, self.time_step, wanted))
        mark_near(plant, models, CHECK_STEPS, self.time_step, wanted)
        horizon = CHECK_STEPS * self.time_step
        self._near_obstacles = self._obstacles.mark_near(plant, models, self._limits, horizon, wanted)
        if not self.bodies.by_number and not self._held:
            return int(let_sleep(plant, models, armed, wanted))
        steps = (self._steps, CHECK_STEPS)
        near, hit = self.bodies.check(plant, models, self._limits, steps, self.time_step, wanted)
        self._near_obstacles += near
        let_sleep(plant, models, armed, wanted)
        wanted[(wanted == ASLEEP) & (hit != 0)] = TOUCHING
        self._hold(armed, wanted)
        return int(np.count_nonzero(wanted != plant["contact"]))

    def _hold(self, armed: NDArray[np.int32], wanted: NDArray[np.int64]) -> None:
        """Make held vehicles sleep until their time has passed or they are armed."""
        over = [i for i, until in self._held.items() if armed[i] or self._steps >= until]
        for i in over:
            del self._held[i]
            wanted[i] = TOUCHING
        wanted[list(self._held)] = ASLEEP

    def inertia(self, target: int) -> tuple[float, list[float]]:
        """Return mass, kg, and principal moments of inertia, kg m^2, of the target of a wrench; see ``Wrench``."""
        if target < len(self.plant):
            m = self.models[target]
            return float(m["mass"]), m["inertia"].tolist()
        body = self.bodies.by_number[target - len(self.plant)]
        return body.mass, body.moments.tolist()

    # requests, between two steps

    def add_model(self, number: int, model: SdfModel, pose: Pose, drive: Drive | None = None) -> None:
        """Add a model at a pose in the world.

        Args:
            number: a number that no model has had; see ``collisions``.
            model: a static one stands, any other is awake.
            pose: pose in the world.
            drive: drive that moves it; None: forces move it.

        Raises:
            SdfError: a mesh file cannot be read.
        """
        body = self.bodies.add(number, model, pose, drive)
        if drive is not None and drive.floats:
            for shape in body.shapes:
                self._bullet.setCollisionFilterPair(shape, self._ground, -1, -1, 0)
        self._index_of.update((shape, len(self._bodies) + number) for shape in body.shapes)

    def overlaps(self, number: int) -> list[tuple[int, float]]:
        """Return the objects that a body currently overlaps: index, as in ``collisions``, and depth, m, of each."""
        own = self.bodies.by_number[number].shapes
        self._bullet.performCollisionDetection()
        found: dict[int, float] = {}
        for shape in own:
            for point in self._bullet.getContactPoints(shape):
                other = self._index_of.get(point[2] if point[1] == shape else point[1])
                if other is not None and point[8] < 0.0:
                    found[other] = max(found.get(other, 0.0), -float(point[8]))
        return sorted(found.items())

    def remove_model(self, number: int) -> None:
        """Remove a model."""
        self._loosen(number)
        for shape in self.bodies.by_number[number].shapes:
            self._index_of.pop(shape, None)
        self.bodies.remove(number)
        self.wrenches.clear(len(self.plant) + number)

    def place_model(self, number: int, pose: Pose, velocity: Vector, spin: Vector, hold: int = 0) -> None:
        """Move a model in the world.

        Args:
            number: number of the model.
            pose, velocity, spin: see ``Bodies.place``.
            hold: steps for which it is held there.
        """
        self._loosen(number)
        self.bodies.place(number, pose, velocity, spin, self._steps + hold if hold else 0)

    def _loosen(self, number: int) -> None:
        """Turn an obstacle of the world into a body without mass, which can be moved and removed."""
        model = self._fixed.pop(number, None)
        if model is None:
            return
        index = len(self._bodies) + number
        for body in [body for body, owner in self._index_of.items() if owner == index]:
            self._bullet.removeBody(body)
            del self._index_of[body]
        self._obstacles = Obstacles(self._fixed)
        self.add_model(number, model, model.pose)

    def place_vehicle(
        self, i: int, position: Vector, q: Quaternion, velocity: Vector, rates: Vector, hold: int = 0
    ) -> None:
        """Move a vehicle.

        Args:
            i: index of the vehicle.
            position: m, world.
            q: (w, x, y, z), body to world.
            velocity: m/s, world.
            rates: rad/s, body.
            hold: steps for which it is held there if its motors are off.
        """
        v = self.plant[i]
        v["position"], v["q"], v["velocity"], v["rates"] = position, q, velocity, rates
        v["acceleration"] = 0.0
        self._held.pop(i, None)
        self._touch(i)
        if hold:
            self._held[i] = self._steps + hold
            v["contact"] = ASLEEP
            self._touching.remove(i)

    def _touch(self, i: int) -> None:
        """Make Bullet integrate vehicle ``i`` from now on, at least until the next check."""
        self._hand_over(i)
        self.plant["contact"][i] = TOUCHING
        self._update_touching()

    def _hand_over(self, i: int) -> None:
        """Make Bullet integrate body ``i`` from its current state."""
        if self._bodies[i] == _NO_BODY:  # of a lost vehicle
            self._restore_body(i)
        v, body = self.plant[i], self._bodies[i]
        v["still_steps"] = 0
        w, x, y, z = v["q"].tolist()
        self._bullet.resetBasePositionAndOrientation(body, v["position"].tolist(), (x, y, z, w))
        spin = dynamics.rotate(v["q"], *v["rates"].tolist())
        self._bullet.resetBaseVelocity(body, v["velocity"].tolist(), spin)
        self._bullet.setCollisionFilterGroupMask(body, -1, 1, -1)

    def _park(self, i: int, *, asleep: bool) -> None:
        """Stop integrating body ``i`` in Bullet; it stays as a static obstacle if asleep, else without collisions."""
        body = self._bodies[i]
        self._bullet.resetBaseVelocity(body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        if asleep:
            self.plant[i]["velocity"] = 0.0
            self.plant[i]["rates"] = 0.0
            self.plant[i]["acceleration"] = 0.0
            self.plant[i]["rotor_speed"] = 0.0
        else:
            self._bullet.setCollisionFilterGroupMask(body, -1, 0, 0)

    def _step_bullet(self) -> None:
        client, plant, models = self._bullet, self.plant, self.models
        gravity, dt = self.model.gravity, self.time_step
        # The client looks up each attribute with inspect, which takes longer than the call.
        apply_force, apply_torque = client.applyExternalForce, client.applyExternalTorque
        pose_of, velocity_of = client.getBasePositionAndOrientation, client.getBaseVelocity
        for i in self._touching.copy():
            v, m = plant[i], models[i]
            fx, fy, fz = v["force"].tolist()
            if not math.isfinite(fx + fy + fz + float(v["torque"].sum())):  # would spread to the bodies that it touches
                self._stop(i)
                continue
            weight = float(m["mass"]) * gravity
            position = v["position"].tolist()
            apply_force(self._bodies[i], -1, (fx, fy, fz - weight), position, pybullet.WORLD_FRAME)
            torque = dynamics.rotate(v["q"], *v["torque"].tolist())
            apply_torque(self._bodies[i], -1, torque, pybullet.WORLD_FRAME)
        if self.bodies.awake:
            for joint in self.joints.values():
                joint.push(dt)
        if self.bodies.by_number:
            self.bodies.push(gravity, dt)
        client.stepSimulation()
        if self.bodies.by_number:
            self.bodies.read()
        for i in self._held:
            self._hand_over(i)
        for i in self._touching.copy():
            v = plant[i]
            position, (x, y, z, w) = pose_of(self._bodies[i])
            velocity, spin = velocity_of(self._bodies[i])
            turn = math.hypot(*spin)
            if turn > FASTEST_TURN:
                spin = tuple(value * FASTEST_TURN / turn for value in spin)
                client.resetBaseVelocity(self._bodies[i], velocity, spin)
            if not sum(map(abs, (*position, x, y, z, w, *velocity, *spin))) < FARTHEST:  # true for NaN as well
                self._stop(i)
                continue
            v["acceleration"] = (np.array(velocity) - v["velocity"]) / dt
            v["position"] = position
            v["velocity"] = velocity
            v["q"] = (w, x, y, z)
            v["rates"] = dynamics.rotate_inverse(v["q"], *spin)
            speed = max(*(abs(value) for value in velocity), *(abs(value) for value in spin))
            spinning = bool(v["rotor_speed"].max() > 1.0)
            v["still_steps"] = v["still_steps"] + 1 if speed < REST_SPEED and not spinning else 0
        if len(self._touching) > 1 or self._near_obstacles:
            self._note_collisions()

    def _stop(self, i: int) -> None:
        """Stop a vehicle whose state has become impossible where it was; see ``vehicle_dynamics.LEAVING``."""
        v = self.plant[i]
        for name in ("velocity", "rates", "acceleration", "force", "torque", "rotor_speed"):
            v[name] = 0.0
        v["contact"] = LEAVING
        self._touching.remove(i)
        self._remove_body(i)

    def _note_collisions(self) -> None:
        """Record the collisions; called only while contacts other than with the ground are possible."""
        for point in self._bullet.getContactPoints():
            a, b = self._index_of.get(point[1]), self._index_of.get(point[2])
            if a is None or b is None or point[8] > 0.0:
                continue
            pair = (min(a, b), max(a, b))
            if pair[0] < len(self._bodies):
                self.collisions.add(pair)

    def contacts(self, i: int) -> list[Contact]:
        """Return the contact points of vehicle ``i`` in the last step that Bullet integrated; none in free flight."""
        if self.plant["contact"][i] not in (TOUCHING, ASLEEP):
            return []
        return contact_points(self._bullet, self._bodies[i], self._index_of)

    def close(self) -> None:
        """Disconnect from Bullet."""
        self._bullet.disconnect()
