"""Movable models: those that fall and can be pushed, and those moved or added by a request.

A movable model is one rigid body of Bullet with the mass of all its links. At rest it sleeps: nothing integrates it
until a vehicle or another moving body comes near. A body without mass stays where it is put. A held body stays too,
until the time of the hold has passed. A driven body, a robot, moves as its drive determines: Bullet gets its velocity,
so that it carries and pushes bodies that touch it, and static bodies stop it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.frames import to_xyzw
from xtdrone_common.poses import Pose, compose, inverse, rotate
from xtdrone_common.rotation import Quaternion, Vector
from xtdrone_sim.kernel import kernel
from xtdrone_sim.physics.bodies.obstacles import shape_array
from xtdrone_sim.physics.contacts.contact_states import REST_SPEED, REST_STEPS
from xtdrone_sim.physics.quiet_pybullet import BulletClient, pybullet
from xtdrone_sim.physics.vehicle_dynamics import ABSENT, FREE, TOUCHING
from xtdrone_worlds.shapes.visual import Geometry
from xtdrone_worlds.worlds.sdf import DEFAULT_INERTIAL, SdfModel
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import box_of
from xtdrone_worlds.worlds.sdf.models.rigid_links import MOST_SHAPES
from xtdrone_worlds.worlds.urdf import combine_masses

_log = logging.getLogger("rosout.simulation")  # a child of ROS's logger, see ``xml_elements``

MOST_PAIRS = 300
"""Largest number of pairs of shapes that a request may make touch in one crowd of bodies."""

_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_TOUCHING = 0.02  # m between boxes that count as touching
_NEAR = 0.1  # m between the boxes of two bodies below which a moving one wakes the other
_ROLLING = 1e-3  # m, rolling and spinning friction: a ball comes to rest
_LOST = 1e6  # m from the origin at which a body has left the world
_TOUCH = 1e-3  # m of overlap above which another body stops a driven one
_STEEP = 0.7  # vertical part of a normal above which a surface is floor or ceiling


@kernel
def mark_near_bodies(plant, models, boxes, speeds, moving, limits, horizon, wanted, near, hit):
    """Set ``wanted`` to TOUCHING for every vehicle in flight that is near a body.

    Vehicles are spheres, bodies boxes, both enlarged by the distance that they can travel until the next check.

    Args:
        plant: (n,) ``PLANT``.
        models: (n,) ``MODEL``.
        boxes: (k, 6) lowest and highest corner of each body, m.
        speeds: (k,) m/s.
        moving: (k,) non-zero if the body has moved lately.
        limits: (2,) see ``mark_near_obstacles``.
        horizon: time until the next check, s.
        wanted: (n,) FREE, TOUCHING or ASLEEP; updated.
        near: (k,) set to 1 for bodies near a moving vehicle; updated.
        hit: (n,) set to 1 for vehicles near a moving body; updated.

    Returns:
        Number of vehicles near a body.
    """
    count = 0
    for i in range(plant.shape[0]):
        v = plant[i]
        if v.contact >= ABSENT:
            continue
        x, y, z = v.position[0], v.position[1], v.position[2]
        speed = math.sqrt(v.velocity[0] ** 2 + v.velocity[1] ** 2 + v.velocity[2] ** 2)
        own = models[i].radius + speed * horizon + (limits[0] if v.contact == FREE else limits[1])
        found = False
        for k in range(boxes.shape[0]):
            b, reach = boxes[k], own + speeds[k] * horizon
            dx = max(max(b[0] - x, x - b[3]), 0.0)
            dy = max(max(b[1] - y, y - b[4]), 0.0)
            dz = max(max(b[2] - z, z - b[5]), 0.0)
            if not dx * dx + dy * dy + dz * dz < reach * reach:
                continue
            found = True
            if v.contact == FREE or (v.contact == TOUCHING and v.still_steps < REST_STEPS):
                near[k] = 1
            if moving[k]:
                hit[i] = 1
        if found:
            count += 1
            if wanted[i] == FREE:
                wanted[i] = TOUCHING
    return count


class Drive(Protocol):
    """Moves a body along a path of its own; see ``robots.wheel_drives.Drive``.

    Attributes:
        yields: whether static bodies stop it.
        floats: whether it ignores the plane z = 0.
    """

    yields: bool
    floats: bool

    @property
    def is_still(self) -> bool:
        """Whether it stands still and has no command to move."""

    def propose(self, dt: float) -> tuple[Pose, Vector, Vector]:
        """Return pose, velocity, m/s, and spin, rad/s, of the model in the world for a step of ``dt``, s."""

    def accept(self) -> None:
        """Apply the step that was proposed last."""

    def block(self) -> None:
        """Stop at once, discarding the step that was proposed last."""

    def place(self, pose: Pose) -> None:
        """Place it at rest at a pose."""


@dataclass(eq=False)
class Body:
    """A model in Bullet.

    Attributes:
        model: its description.
        frame: principal axes at the centre of mass, in the model's frame; the model's frame of a body without mass.
        mass: kg; 0: it is static.
        moments: principal moments of inertia (3,), kg m^2.
        weight: share of the mass that has weight.
        shapes: Bullet's bodies; one of a body with mass, none if nothing of it collides.
        corners: lowest and highest corner of each shape of the model (s, 2, 3), m, in ``frame``.
        box: lowest and highest corner of all (2, 3), m, in ``frame``.
        pose: pose of the model in the world.
        velocity: velocity of the model's origin, m/s, world.
        spin: rad/s, world.
        held: step until which it is held where it was put.
        still_steps: steps at rest.
        drive: drive that moves it; None: forces move it.
        way: pose, velocity and spin that the drive has proposed for the current step.
    """

    model: SdfModel
    frame: Pose
    mass: float
    moments: NDArray[np.float64]
    weight: float
    shapes: list[int]
    corners: NDArray[np.float64]
    box: NDArray[np.float64]
    pose: Pose
    velocity: Vector = (0.0, 0.0, 0.0)
    spin: Vector = (0.0, 0.0, 0.0)
    held: int = 0
    still_steps: int = 0
    drive: Drive | None = None
    way: tuple[Pose, Vector, Vector] = (Pose(), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    force: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    torque: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    @property
    def is_solid(self) -> bool:
        """Whether Bullet can move it."""
        return self.mass > 0.0 and bool(self.shapes)

    @cached_property
    def reach(self) -> float:
        """Greatest distance of a point of its box from the model's origin, m."""
        return float(np.linalg.norm(np.abs(self.box).max(axis=0))) + math.hypot(*self.frame.position)

    def boxes_at(self, pose: Pose) -> NDArray[np.float64]:
        """Return the boxes (s, 6) of its shapes, m, world, with the model at a pose."""
        frame = compose(pose, self.frame)
        turn = np.array([rotate(frame.orientation, axis) for axis in _AXES]).T
        middle = 0.5 * (self.corners[:, 0] + self.corners[:, 1]) @ turn.T + frame.position
        half = 0.5 * (self.corners[:, 1] - self.corners[:, 0]) @ np.abs(turn).T
        return np.concatenate([middle - half, middle + half], axis=1)

    @property
    def centre(self) -> Vector:
        """The centre of mass in the world, m."""
        return compose(self.pose, self.frame).position


def mass_of(model: SdfModel) -> tuple[float, Pose, NDArray[np.float64]]:
    """Return the mass of all links as one rigid body.

    Returns:
        Mass, kg; the principal axes at the centre of mass, in the model's frame; principal moments (3,), kg m^2.
    """
    parts = [(link.inertial or DEFAULT_INERTIAL, link.pose) for link in model.links]
    mass, centre, total = combine_masses([(part, compose(pose, part.pose)) for part, pose in parts])
    moments, axes = _principal(total)
    x, y, z = centre.tolist()
    return float(mass), Pose((x, y, z), axes), moments


def _principal(inertia: NDArray[np.float64]) -> tuple[NDArray[np.float64], Quaternion]:
    """Return the principal moments and the rotation (w, x, y, z) from their axes; none if they are the frame's own."""
    if np.count_nonzero(inertia - np.diag(np.diag(inertia))) == 0:
        return np.diag(inertia).copy(), (1.0, 0.0, 0.0, 0.0)
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] = -axes[:, 0]
    return moments, _quaternion(axes)


def _quaternion(matrix: NDArray[np.float64]) -> Quaternion:
    """Return the quaternion (w, x, y, z) of a rotation matrix, from its eigenvector of the largest eigenvalue.

    I. Bar-Itzhack, "New method for extracting the quaternion from a rotation matrix", JGCD 23(6), 2000.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix.tolist()
    k = np.array(
        [
            [xx - yy - zz, yx + xy, zx + xz, zy - yz],
            [yx + xy, yy - xx - zz, zy + yz, xz - zx],
            [zx + xz, zy + yz, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1].tolist()
    return (w, x, y, z)


class Bodies:
    """All movable models of a world.

    Attributes:
        by_number: bodies by the model's number; see ``World.collisions``.
        awake: numbers of the bodies that Bullet moves.
        people: numbers of the bodies that are people.
        tied: by number, the numbers of all bodies that joints connect to it: they wake and sleep together.
        before_removal: function called with the number of a body before it is removed from Bullet.
    """

    def __init__(self, client: BulletClient, friction: float, restitution: float) -> None:
        """Start without bodies.

        Args:
            client: Bullet, without gravity.
            friction, restitution: of all bodies.
        """
        self.by_number: dict[int, Body] = {}
        self.awake: set[int] = set()
        self.people: set[int] = set()
        self.tied: dict[int, frozenset[int]] = {}
        self.before_removal: Callable[[int], None] = lambda _number: None
        self._client = client
        self._surface = {"lateralFriction": friction, "restitution": restitution}

    @property
    def models(self) -> dict[int, Body]:
        """All bodies except people, by number."""
        if not self.people:
            return self.by_number
        return {number: body for number, body in self.by_number.items() if number not in self.people}

    def add(self, number: int, model: SdfModel, pose: Pose, drive: Drive | None = None) -> Body:
        """Create a body at a pose; one with mass is awake.

        Args:
            number: number of its model.
            model: its description; that of a driven body has its centre of mass at the origin.
            pose: pose of the model in the world.
            drive: what moves it; None: forces.

        Raises:
            SdfError: a mesh file cannot be read.
        """
        body, placed = _describe(model, pose, drive)
        start = compose(pose, body.frame)
        mass = body.mass
        body.shapes = shapes = [
            self._client.createMultiBody(
                mass,
                shape_array(self._client, placed[k : k + MOST_SHAPES], hollow=mass == 0.0),
                basePosition=start.position,
                baseOrientation=to_xyzw(start.orientation),
            )
            for k in range(0, len(placed), MOST_SHAPES)
        ]
        settings = dict(self._surface)
        if mass > 0.0:
            settings |= {"linearDamping": 0.0, "angularDamping": 0.0, "localInertiaDiagonal": body.moments.tolist()}
            settings |= {"rollingFriction": _ROLLING, "spinningFriction": _ROLLING}
            settings |= {"activationState": pybullet.ACTIVATION_STATE_DISABLE_SLEEPING}
        for shape in shapes:
            self._client.changeDynamics(shape, -1, **settings)
        self.by_number[number] = body
        if body.is_solid:
            self.awake.add(number)
        return body

    def crowd(self, model: SdfModel, pose: Pose, number: int | None = None) -> int:
        """Return the pairs of shapes that would touch in the crowd around a model, at most ``MOST_PAIRS`` + 1.

        The crowd are the bodies with mass whose boxes touch the model's, those that touch these, and so on; static
        bodies connect no others. Bullet's work in a step grows with the square of the pairs.

        Args:
            model: a model that is to be added, or moved.
            pose: its pose in the world then.
            number: its number if it is in the world already.
        """
        there = None if number is None else self.by_number.get(number)
        first = there or _describe(model, pose, None)[0]
        others = [body for body in self.by_number.values() if body is not there and body.shapes]
        places = np.array([body.pose.position for body in others]).reshape(-1, 3)
        reaches = np.array([body.reach for body in others])
        waiting, reached, pairs = [(first, pose, -1)], {-1}, 0
        done: set[int] = set()
        while waiting and pairs <= MOST_PAIRS:
            body, place, own = waiting.pop()
            done.add(own)
            near = np.linalg.norm(places - place.position, axis=1) < reaches + body.reach + 2.0 * _TOUCHING
            boxes = body.boxes_at(place)
            for k in np.flatnonzero(near).tolist():
                other = others[k]
                if k in done or not (body.mass or other.mass):
                    continue
                found = _touching(boxes, other.boxes_at(other.pose))
                pairs += found
                if found and other.mass and k not in reached:
                    reached.add(k)
                    waiting.append((other, other.pose, k))
        return min(pairs, MOST_PAIRS + 1)

    def remove(self, number: int) -> None:
        """Remove a body, and wake those that may rest on it."""
        boxes, _ = self._bounds([number])
        self.before_removal(number)
        body = self.by_number.pop(number)
        self.awake.discard(number)
        for shape in body.shapes:
            self._client.removeBody(shape)
        self.wake_around(boxes)

    def place(self, number: int, pose: Pose, velocity: Vector, spin: Vector, held: int = 0) -> None:
        """Place a body.

        Args:
            number: number of its model.
            pose: pose of the model in the world.
            velocity, spin: of the model, m/s and rad/s, world.
            held: step until which it is held there.
        """
        body = self.by_number[number]
        before, _ = self._bounds([number])
        body.pose, body.velocity, body.spin, body.held, body.still_steps = pose, velocity, spin, held, 0
        if body.drive is not None:
            body.drive.place(pose)
        self._reset(body, moving=not held)
        self.awake.discard(number)
        if body.is_solid and not held:
            self.wake(number)
        self.wake_around(before)

    def _reset(self, body: Body, *, moving: bool) -> None:
        centre = compose(body.pose, body.frame)
        for shape in body.shapes:
            self._client.resetBasePositionAndOrientation(shape, centre.position, to_xyzw(centre.orientation))
        if body.is_solid:
            still = (0.0, 0.0, 0.0)
            velocity = _at(body.velocity, body.spin, _arm(body)) if moving else still
            self._client.resetBaseVelocity(body.shapes[0], velocity, body.spin if moving else still)

    def wake(self, number: int) -> None:
        """Wake a body with mass and those tied to it: Bullet moves them, at least until they are at rest."""
        for tied in self.tied.get(number, (number,)):
            self.by_number[tied].still_steps = 0
            self.awake.add(tied)

    def check(
        self,
        plant: NDArray[np.void],
        models: NDArray[np.void],
        limits: NDArray[np.float64],
        steps: tuple[int, int],
        dt: float,
        wanted: NDArray[np.int64],
    ) -> tuple[int, NDArray[np.int64]]:
        """Mark vehicles near bodies, wake bodies near moving ones, and end holds.

        Args:
            plant, models, limits, wanted: see ``mark_near_bodies``.
            steps: number of the next step, and the steps until the next check.
            dt: s.

        Returns:
            The number of vehicles near a body, and (n,) 1 for vehicles near a moving body.
        """
        now, ahead = steps
        numbers = list(self.by_number)
        for number in numbers:
            body = self.by_number[number]
            if body.held and now >= body.held:
                body.held = 0
                self._reset(body, moving=True)
                if body.is_solid:
                    self.wake(number)
            elif number not in self.awake:
                body.still_steps += ahead
        boxes, speeds = self._bounds(numbers)
        moving = np.array([self.by_number[number].still_steps < REST_STEPS for number in numbers], np.int64)
        near, hit = np.zeros(len(numbers), np.int64), np.zeros(len(plant), np.int64)
        count = mark_near_bodies(plant, models, boxes, speeds, moving, limits, ahead * dt, wanted, near, hit)
        self._wake_near(numbers, boxes, near)
        return int(count), hit

    def _bounds(self, numbers: list[int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the boxes (k, 6), m, and the maximum speeds (k,), m/s, of bodies."""
        boxes, speeds = np.empty((len(numbers), 6)), np.empty(len(numbers))
        for k, number in enumerate(numbers):
            body = self.by_number[number]
            frame = compose(body.pose, body.frame)
            turn = np.array([rotate(frame.orientation, axis) for axis in _AXES]).T
            middle = turn @ (0.5 * (body.box[0] + body.box[1])) + frame.position
            half = np.abs(turn) @ (0.5 * (body.box[1] - body.box[0]))
            boxes[k, :3], boxes[k, 3:] = middle - half, middle + half
            speeds[k] = math.hypot(*body.velocity) + math.hypot(*body.spin) * float(np.linalg.norm(half))
        return boxes, speeds

    def _wake_near(self, numbers: list[int], boxes: NDArray[np.float64], near: NDArray[np.int64]) -> None:
        """Wake sleeping bodies near a vehicle or another moving body."""
        moves = [self.by_number[k].still_steps < (1 if k in self.awake else REST_STEPS) for k in numbers]
        near = near | _meet(boxes[moves], boxes)
        for k in np.flatnonzero(near):
            self._wake_sleeper(numbers[k])

    def wake_around(self, boxes: NDArray[np.float64]) -> None:
        """Wake sleeping bodies near boxes (k, 6), m."""
        numbers = list(self.by_number)
        for k in np.flatnonzero(_meet(boxes, self._bounds(numbers)[0])):
            self._wake_sleeper(numbers[k])

    def _wake_sleeper(self, number: int) -> None:
        body = self.by_number[number]
        if body.is_solid and not body.held and number not in self.awake:
            self.wake(number)

    def push(self, gravity: float, dt: float) -> None:
        """Apply weight, wrenches and drives for the next step of Bullet, of ``dt``, s."""
        apply_force, apply_torque = self._client.applyExternalForce, self._client.applyExternalTorque
        for number in sorted(self.awake):
            body = self.by_number[number]
            if body.drive is not None:
                self._drive(body, body.drive, dt)
                continue
            fx, fy, fz = body.force
            force = (fx, fy, fz - body.weight * body.mass * gravity)
            apply_force(body.shapes[0], -1, force, body.centre, pybullet.WORLD_FRAME)
            if any(body.torque):
                apply_torque(body.shapes[0], -1, body.torque, pybullet.WORLD_FRAME)
                body.torque = [0.0, 0.0, 0.0]
            if any(body.force):
                body.force = [0.0, 0.0, 0.0]

    def read(self) -> None:
        """Read the motion from Bullet after its step, and put bodies at rest to sleep."""
        pose_of, velocity_of = self._client.getBasePositionAndOrientation, self._client.getBaseVelocity
        for number, body in self.by_number.items():
            if body.drive is not None:
                self._follow(number, body, body.drive)
        for number in sorted(self.awake):
            body = self.by_number[number]
            if body.drive is not None:
                continue
            position, (x, y, z, w) = pose_of(body.shapes[0])
            velocity, spin = velocity_of(body.shapes[0])
            if not max(map(abs, position)) < _LOST:  # true for NaN as well
                self._lose(number, body)
                continue
            body.pose = compose(Pose(tuple(position), (w, x, y, z)), inverse(body.frame))
            body.spin = tuple(spin)
            x, y, z = _arm(body)
            body.velocity = _at(velocity, body.spin, (-x, -y, -z))
            speed = max(*(abs(value) for value in velocity), *(abs(value) for value in spin))
            body.still_steps = body.still_steps + 1 if speed < REST_SPEED else 0
            if body.still_steps >= REST_STEPS and number not in self.tied:
                self._put_to_sleep(number, body)
        for group in set(self.tied.values()):
            self._rest_together(group)
        for body in self.by_number.values():
            if body.held:
                self._reset(body, moving=False)

    def _rest_together(self, group: frozenset[int]) -> None:
        """Put bodies connected by joints to sleep once all of them are at rest."""
        if group <= self.awake and all(self.by_number[number].still_steps >= REST_STEPS for number in group):
            for number in sorted(group):
                self._put_to_sleep(number, self.by_number[number])

    def _drive(self, body: Body, drive: Drive, dt: float) -> None:
        """Give Bullet the velocity of a driven body for its next step."""
        body.force, body.torque = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        _, velocity, spin = body.way = drive.propose(dt)
        self._client.resetBaseVelocity(body.shapes[0], velocity, spin)

    def _follow(self, number: int, body: Body, drive: Drive) -> None:
        """Place a driven body where its drive has moved it in Bullet's last step, unless another body stopped it."""
        if number in self.awake:
            if drive.yields and self._is_blocked(body):
                drive.block()
                body.velocity = body.spin = (0.0, 0.0, 0.0)
            else:
                drive.accept()
                body.pose, body.velocity, body.spin = body.way
            body.still_steps = body.still_steps + 1 if drive.is_still else 0
            if body.still_steps >= REST_STEPS:
                self._put_to_sleep(number, body)
        self._reset(body, moving=True)

    def _is_blocked(self, body: Body) -> bool:
        """Return whether a driven body runs into a static or another driven body."""
        _, velocity, spin = body.way
        own, origin = body.shapes[0], np.array(body.pose.position)
        if not any(velocity) and not any(spin):
            return False
        for point in self._client.getContactPoints(own):
            side = 1.0 if point[1] == own else -1.0
            other = point[2] if point[1] == own else point[1]
            normal = side * np.array(point[7])  # from the other to this body
            if point[8] > -_TOUCH or abs(normal[2]) > _STEEP or not self._is_firm(other):
                continue
            arm = np.array(point[5] if point[1] == own else point[6]) - origin
            if float((np.array(velocity) + np.cross(spin, arm)) @ normal) < 0.0:
                return True
        return False

    def _is_firm(self, shape: int) -> bool:
        driven = any(shape in body.shapes for body in self.by_number.values() if body.drive is not None)
        return driven or self._client.getDynamicsInfo(shape, -1)[0] == 0.0

    def _put_to_sleep(self, number: int, body: Body) -> None:
        self.awake.discard(number)
        body.velocity = body.spin = (0.0, 0.0, 0.0)
        self._client.resetBaseVelocity(body.shapes[0], (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    def _lose(self, number: int, body: Body) -> None:
        """Remove a body that has left the world from Bullet; it stays at its last position, without collisions."""
        self.before_removal(number)
        self._client.removeBody(body.shapes[0])
        self.awake.discard(number)
        body.shapes, body.mass = [], 0.0
        body.velocity = body.spin = (0.0, 0.0, 0.0)
        x, y, z = body.pose.position
        _log.warning(
            "simulator: %s is out of the world: it stays at (%.4g, %.4g, %.4g) m, without collisions, until a restart",
            body.model.name,
            x,
            y,
            z,
        )


def _describe(model: SdfModel, pose: Pose, drive: Drive | None) -> tuple[Body, list[tuple[Geometry, Pose]]]:
    """Return the body of a model at a pose without shapes in Bullet, and its shapes with their poses in its frame.

    Raises:
        SdfError: a mesh file cannot be read.
    """
    mass, frame, moments = (0.0, Pose(), np.zeros(3)) if model.static else mass_of(model)
    back = inverse(frame)
    placed = [
        (shape.geometry, compose(back, compose(link.pose, shape.pose)))
        for link in model.links
        for shape in link.collisions
    ]
    corners = np.array([box_of(*shape) for shape in placed], float).reshape(-1, 2, 3)
    box = np.array([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)]) if len(corners) else np.zeros((2, 3))
    heavy = [link for link in model.links if link.gravity]
    weight = len(heavy) / len(model.links) if model.links else 0.0
    return Body(model, frame, mass, moments, weight, [], corners, box, pose, drive=drive), placed


def _touching(some: NDArray[np.float64], others: NDArray[np.float64]) -> int:
    """Return the number of pairs of boxes (j, 6) and (k, 6) that touch."""
    low, high = some[:, None, :3] - _TOUCHING, some[:, None, 3:] + _TOUCHING
    return int(((low <= others[None, :, 3:]) & (others[None, :, :3] <= high)).all(axis=2).sum())


def _meet(some: NDArray[np.float64], boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of ``boxes`` (k, 6) are near ``some`` (j, 6)."""
    low, high = some[:, None, :3] - _NEAR, some[:, None, 3:] + _NEAR
    meets: NDArray[np.bool_] = ((low <= boxes[None, :, 3:]) & (boxes[None, :, :3] <= high)).all(axis=2).any(axis=0)
    return meets


def _arm(body: Body) -> Vector:
    """Return the vector from the model's origin to the centre of mass, m, world."""
    return rotate(body.pose.orientation, body.frame.position)


def _at(velocity: Vector, spin: Vector, arm: Vector) -> Vector:
    """Return the velocity of the point at ``arm`` of a body."""
    sweep = np.cross(spin, arm).tolist()
    return (velocity[0] + sweep[0], velocity[1] + sweep[1], velocity[2] + sweep[2])
