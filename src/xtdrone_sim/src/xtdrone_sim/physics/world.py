"""The physical world: free flight integrated by a kernel, contacts by Bullet, in one ``step``.

A vehicle far from the ground, from obstacles and from all other vehicles is integrated by ``plant.integrate_free``;
near them Bullet integrates it under the same wrench. A vehicle at rest with its motors off sleeps. Gravity is off in
Bullet: weight is part of the wrench, so parked bodies stay in place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.geodesy.datum import Datum
from xtdrone_sim.effects import Effects, drive_rotors, integrate_all
from xtdrone_sim.kernel import kernel
from xtdrone_sim.physics import plant as dynamics
from xtdrone_sim.physics.bullet import connect, pybullet
from xtdrone_sim.physics.obstacles import Obstacles
from xtdrone_sim.physics.plant import ASLEEP, FREE, PLANT, TOUCHING
from xtdrone_sim.vehicles.vehicle_model import MODEL, VehicleModel
from xtdrone_sim.worlds.sdf import SdfActor, SdfModel, load_world_file

CHECK_STEPS = 5  # steps between two updates of the contact states; margins cover the motion in between
_NEAR = 0.25  # m of clearance below which Bullet integrates a body
_FAR = 0.40  # m of clearance above which the free-flight kernel does again
_REST_SPEED = 0.02  # m/s and rad/s below which a body with its motors off counts as at rest
_REST_STEPS = 125  # steps at rest before it sleeps
_CAUTION = 2.0  # times the acceleration by rotors at full speed, weight and drag: the most that a body may reach
_FASTEST_SPIN = 20.0  # rad/s below which the drag of rotation is far less than this reserve
_SPAWN_GAP = 0.001  # m between a spawned body and the ground


@dataclass(frozen=True)
class WorldModel:
    """The content of a world description.

    Attributes:
        datum: WGS84 position of the map frame's origin.
        gravity: m/s^2.
        magnetic_field: gauss, ENU.
        declination: degrees east.
        wind: m/s, ENU.
        friction, restitution: of the ground and of the models.
        models: static models.
        actors: moving people.
    """

    datum: Datum
    gravity: float
    magnetic_field: NDArray[np.float64]
    declination: float
    wind: NDArray[np.float64]
    friction: float
    restitution: float
    models: tuple[SdfModel, ...] = ()
    actors: tuple[SdfActor, ...] = ()


def load_world(name: str) -> WorldModel:
    """Return the world ``name``; see ``sdf.load_world_file``.

    Raises:
        ModelError: the world is unknown, a field is missing, or a value is not allowed.
    """
    world = load_world_file(name)
    return WorldModel(
        world.datum,
        world.gravity,
        np.array(world.magnetic_field),
        world.declination,
        np.array(world.wind),
        world.friction,
        world.restitution,
        world.models,
        world.actors,
    )


@kernel
def sort_contacts(plant, models, armed, steps, dt, wanted):
    """Fill ``wanted`` (n,) with FREE, TOUCHING or ASLEEP for every vehicle; return the number of changes."""
    mark_near(plant, models, steps, dt, wanted)
    return let_sleep(plant, models, armed, wanted)


@kernel
def mark_near(plant, models, steps, dt, wanted):
    """Fill ``wanted`` (n,) with TOUCHING for vehicles near the ground or each other, with FREE for all others.

    Vehicles are spheres around the collision boxes, enlarged by the distance travelled until the next check.
    """
    count = plant.shape[0]
    for i in range(count):
        v, m = plant[i], models[i]
        reach = abs(v.velocity[2]) * steps * dt
        clearance = v.position[2] - m.radius - reach
        near = clearance < (_NEAR if v.contact == FREE else _FAR)
        wanted[i] = TOUCHING if near else FREE
    for i in range(count):
        v = plant[i]
        for j in range(i):
            o = plant[j]
            dx = v.position[0] - o.position[0]
            dy = v.position[1] - o.position[1]
            dz = v.position[2] - o.position[2]
            threshold = models[i].radius + models[j].radius + _FAR + 10.0 * steps * dt
            squared = dx * dx + dy * dy + dz * dz
            if squared > threshold * threshold:
                continue
            rvx = v.velocity[0] - o.velocity[0]
            rvy = v.velocity[1] - o.velocity[1]
            rvz = v.velocity[2] - o.velocity[2]
            reach = math.sqrt(rvx * rvx + rvy * rvy + rvz * rvz) * steps * dt
            clearance = math.sqrt(squared) - models[i].radius - models[j].radius - reach
            if clearance < (_NEAR if v.contact == FREE or o.contact == FREE else _FAR):
                wanted[i] = TOUCHING
                wanted[j] = TOUCHING


@kernel
def _most_acceleration(v, m, gravity):
    """Return a bound of the acceleration within the next tenth of a second, m/s^2."""
    thrust = m.rotor_count * m.thrust_constant * m.max_speed * m.max_speed
    ax, ay, az = v.velocity[0] - v.wind[0], v.velocity[1] - v.wind[1], v.velocity[2] - v.wind[2]
    drag = m.linear_drag + m.rotor_count * m.drag_coefficient * m.max_speed
    return _CAUTION * (gravity + (thrust + drag * math.sqrt(ax * ax + ay * ay + az * az)) / m.mass)


@kernel
def stay_free(plant, models, steps, gravity, dt):
    """Return whether all vehicles are free and no contact check of the next ``steps``, 0.1 s at most, finds a change.

    After the time t a body is at most v t + a t^2 / 2 from its place and v + a t fast, with its speed v and bound a of
    its acceleration. ``mark_near`` adds the distance travelled until the check that follows.
    """
    count = plant.shape[0]
    most = np.empty(count)
    time = steps * dt
    ahead = CHECK_STEPS * dt
    for i in range(count):
        v, m = plant[i], models[i]
        spin = v.rates[0] * v.rates[0] + v.rates[1] * v.rates[1] + v.rates[2] * v.rates[2]
        if v.contact != FREE or not spin < _FASTEST_SPIN * _FASTEST_SPIN:
            return False
        most[i] = _most_acceleration(v, m, gravity)
        reach = abs(v.velocity[2]) * (time + ahead) + most[i] * time * (0.5 * time + ahead)
        if not v.position[2] - m.radius - reach > _NEAR:
            return False
    for i in range(count):
        v = plant[i]
        for j in range(i):
            o = plant[j]
            dx = v.position[0] - o.position[0]
            dy = v.position[1] - o.position[1]
            dz = v.position[2] - o.position[2]
            rvx = v.velocity[0] - o.velocity[0]
            rvy = v.velocity[1] - o.velocity[1]
            rvz = v.velocity[2] - o.velocity[2]
            reach = math.sqrt(rvx * rvx + rvy * rvy + rvz * rvz) * (time + ahead)
            reach += (most[i] + most[j]) * time * (0.5 * time + ahead)
            least = models[i].radius + models[j].radius + _NEAR + reach
            if not dx * dx + dy * dy + dz * dz > least * least:
                return False
    return True


@kernel
def let_sleep(plant, models, armed, wanted):
    """Set ``wanted`` (n,) to ASLEEP for vehicles at rest; return the number of changes."""
    changes = 0
    for i in range(plant.shape[0]):
        v = plant[i]
        if v.contact == ASLEEP:
            wanted[i] = TOUCHING if armed[i] or _disturbed(plant, models, i) else ASLEEP
        elif wanted[i] == TOUCHING and not armed[i] and v.still_steps >= _REST_STEPS:
            wanted[i] = ASLEEP
        if wanted[i] != v.contact:
            changes += 1
    return changes


@kernel
def _disturbed(plant, models, i):
    """Return whether a moving body is within reach of the sleeping vehicle ``i``."""
    v = plant[i]
    for j in range(plant.shape[0]):
        o = plant[j]
        if j == i or o.contact == ASLEEP:
            continue
        dx = v.position[0] - o.position[0]
        dy = v.position[1] - o.position[1]
        dz = v.position[2] - o.position[2]
        reach = models[i].radius + models[j].radius + _NEAR
        if dx * dx + dy * dy + dz * dz < reach * reach:
            return True
    return False


class World:
    """All bodies of the world and their motion.

    Attributes:
        plant: (n,) ``PLANT``, true state of the vehicles.
        models: (n,) ``MODEL``.
        time_step: s.
        collisions: pairs that have touched since the start, lower index first: vehicles, and from n on the models of
            world.
    """

    def __init__(
        self,
        model: WorldModel,
        vehicles: Sequence[VehicleModel],
        places: Sequence[tuple[float, float, float]],
        time_step: float,
        effects: Effects | None = None,
    ) -> None:
        """Place the vehicles.

        Args:
            model: the world.
            vehicles: one model per vehicle.
            places: (x, y, z), m ENU, of the ground under each vehicle.
            time_step: s.
            effects: further forces and torques; their ``begin`` is called with ``plant`` before the first step.
        """
        count = len(vehicles)
        self.model = model
        self._effects = effects
        self.time_step = time_step
        self.plant = np.zeros(count, PLANT)
        self.models = np.zeros(count, MODEL)
        self.collisions: set[tuple[int, int]] = set()
        for i, vehicle in enumerate(vehicles):
            self.models[i] = vehicle.record
        self.plant["position"] = np.asarray(places, float)
        self.plant["position"][:, 2] += 0.5 * self.models["box"][:, 2] + _SPAWN_GAP
        self.plant["q"][:, 0] = 1.0
        self.plant["wind"] = model.wind
        self.plant["contact"] = TOUCHING
        self._wanted = np.full(count, TOUCHING)
        self._steps = 0
        self._checked = -1  # step before which the contact states have been updated
        self._obstacles = Obstacles(model.models)
        self._near_obstacles = 0
        self._limits = np.array([_NEAR, _FAR])
        self._bullet = connect()
        self._load_bullet()
        self._touching = list(range(count))

    def _load_bullet(self) -> None:
        client = self._bullet
        client.setTimeStep(self.time_step)
        client.setGravity(0.0, 0.0, 0.0)
        ground = client.createCollisionShape(pybullet.GEOM_PLANE)
        self._ground = client.createMultiBody(0.0, ground)
        client.changeDynamics(self._ground, -1, lateralFriction=self.model.friction, restitution=self.model.restitution)
        self._bodies = []
        for v, m in zip(self.plant, self.models, strict=True):
            shape = client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=(0.5 * m["box"]).tolist())
            body = client.createMultiBody(float(m["mass"]), shape, basePosition=v["position"].tolist())
            client.changeDynamics(
                body,
                -1,
                localInertiaDiagonal=m["inertia"].tolist(),
                linearDamping=0.0,
                angularDamping=0.0,
                lateralFriction=self.model.friction,
                restitution=self.model.restitution,
                activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            )
            self._bodies.append(body)
        self._index_of = {body: i for i, body in enumerate(self._bodies)}
        owners = self._obstacles.load(client, self.model.friction, self.model.restitution)
        self._index_of.update((body, len(self._bodies) + owner) for body, owner in owners.items())

    def step(self, actuators: NDArray[np.float64], armed: NDArray[np.int32]) -> None:
        """Advance the world by one time step under motor commands (n, MAX_ROTORS), 0..1, and armed flags (n,)."""
        self.check_contacts(armed)
        self._steps += 1
        gravity, dt = self.model.gravity, self.time_step
        if self._effects is None:
            touching = dynamics.step_all(self.plant, self.models, actuators, armed, gravity, dt)
        else:
            drive_rotors(self.plant, self.models, actuators, armed, dt)
            self._effects.apply(armed)
            touching = integrate_all(self.plant, self.models, armed, gravity, dt)
        if touching:
            self._step_bullet()

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
        """Return ``most`` (steps, 0.1 s at most) if all vehicles surely touch nothing until then, else 0."""
        free = not self._obstacles.count and stay_free(
            self.plant, self.models, most, self.model.gravity, self.time_step
        )
        return most if free else 0

    @property
    def has_obstacles(self) -> bool:
        """Whether the vehicles can touch models of the world."""
        return self._obstacles.count > 0

    def count_steps(self, steps: int) -> None:
        """Count steps in which other code has advanced ``plant``, with the contact checks between them."""
        self._steps += steps

    def _sort_contacts(self, armed: NDArray[np.int32]) -> None:
        if not self._changed_contacts(armed):
            return
        contact = self.plant["contact"]
        for i in np.flatnonzero(self._wanted != contact):
            if self._wanted[i] == TOUCHING:
                self._hand_over(i)
            else:
                self._park(i, asleep=bool(self._wanted[i] == ASLEEP))
        contact[:] = self._wanted
        self._touching = np.flatnonzero(contact == TOUCHING).tolist()

    def _changed_contacts(self, armed: NDArray[np.int32]) -> int:
        """Fill ``_wanted`` with the contact state of each vehicle; return the number of changes."""
        plant, models, wanted = self.plant, self.models, self._wanted
        if not self._obstacles.count:
            return int(sort_contacts(plant, models, armed, CHECK_STEPS, self.time_step, wanted))
        mark_near(plant, models, CHECK_STEPS, self.time_step, wanted)
        horizon = CHECK_STEPS * self.time_step
        self._near_obstacles = self._obstacles.mark_near(plant, models, self._limits, horizon, wanted)
        return int(let_sleep(plant, models, armed, wanted))

    def _hand_over(self, i: int) -> None:
        """Make Bullet integrate body ``i`` from its current state."""
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
        for i in self._touching:
            v, m = plant[i], models[i]
            fx, fy, fz = v["force"].tolist()
            weight = float(m["mass"]) * gravity
            position = v["position"].tolist()
            apply_force(self._bodies[i], -1, (fx, fy, fz - weight), position, pybullet.WORLD_FRAME)
            apply_torque(self._bodies[i], -1, self._world_torque(v), pybullet.WORLD_FRAME)
        client.stepSimulation()
        for i in self._touching:
            v = plant[i]
            position, (x, y, z, w) = pose_of(self._bodies[i])
            velocity, spin = velocity_of(self._bodies[i])
            v["acceleration"] = (np.array(velocity) - v["velocity"]) / dt
            v["position"] = position
            v["velocity"] = velocity
            v["q"] = (w, x, y, z)
            v["rates"] = dynamics.rotate_inverse(v["q"], *spin)
            speed = max(*(abs(value) for value in velocity), *(abs(value) for value in spin))
            spinning = bool(v["rotor_speed"].max() > 1.0)
            v["still_steps"] = v["still_steps"] + 1 if speed < _REST_SPEED and not spinning else 0
        if len(self._touching) > 1 or self._near_obstacles:
            self._note_collisions()

    @staticmethod
    def _world_torque(v: np.void) -> tuple[float, float, float]:
        return dynamics.rotate(v["q"], *v["torque"].tolist())

    def _note_collisions(self) -> None:
        """Record the collisions; called only while contacts other than with the ground are possible."""
        for point in self._bullet.getContactPoints():
            a, b = self._index_of.get(point[1]), self._index_of.get(point[2])
            if a is None or b is None or point[8] > 0.0:
                continue
            pair = (min(a, b), max(a, b))
            self.collisions.add(pair)

    def close(self) -> None:
        """Disconnect from Bullet."""
        self._bullet.disconnect()
