"""Joints between movable models: hinges, slides and balls as constraints of Bullet.

A hinge is two points of its axis that both bodies share, a slide Bullet's prismatic constraint. Limits, damping and
friction are torques and forces on both bodies, no larger than those that stop the motion within one step, so that none
of them adds energy.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.frames import to_xyzw
from xtdrone_common.poses import Pose, compose, conjugate, inverse, rotate
from xtdrone_common.rotation import Quaternion, Vector, multiply
from xtdrone_sim.physics.bodies.movable_bodies import Body
from xtdrone_sim.physics.quiet_pybullet import BulletClient, pybullet
from xtdrone_worlds.worlds.sdf import SdfJoint

_HALF = 0.25  # m from a hinge's anchor to the points of its axis
_STRONGEST = 1e6  # N, of a constraint
_RETURN = 0.2  # share of the excess beyond a limit that is corrected in a step

Array = NDArray[np.float64]


class ModelJoint:
    """A joint in Bullet.

    Attributes:
        joint: its description.
        parent: body; None: the world.
        child: body.
    """

    def __init__(self, client: BulletClient, joint: SdfJoint, parent: Body | None, child: Body) -> None:
        """Connect two bodies at their current poses.

        Args:
            client: Bullet.
            joint: description, in the world at the current poses.
            parent: body; None: the world.
            child: body, with mass.
        """
        self.joint, self.parent, self.child = joint, parent, child
        self._client = client
        self._frames = [_in_body(body, joint.anchor, joint.axis) for body in (parent, child)]
        self._start = self._relative()
        self._held = 0.0  # position that friction holds
        self._constraints = [self._connect(point) for point in self._points()]
        if parent is not None:
            client.setCollisionFilterPair(parent.shapes[0], child.shapes[0], -1, -1, 0)

    def _points(self) -> list[Vector]:
        anchor = self.joint.anchor
        if self.joint.kind in ("ball", "prismatic"):
            return [anchor]
        return [tuple(np.add(anchor, np.multiply(side * _HALF, self.joint.axis)).tolist()) for side in (-1.0, 1.0)]

    def _connect(self, point: Vector) -> int:
        """Create a constraint at a point in the world."""
        client, slides = self._client, self.joint.kind == "prismatic"
        place, still = Pose(point), (0.0, 0.0, 0.0)
        own = compose(inverse(compose(self.child.pose, self.child.frame)), place)
        other = place
        if self.parent is not None:
            other = compose(inverse(compose(self.parent.pose, self.parent.frame)), place)
        constraint = client.createConstraint(
            self.child.shapes[0],
            -1,
            -1 if self.parent is None else self.parent.shapes[0],
            -1,
            pybullet.JOINT_PRISMATIC if slides else pybullet.JOINT_POINT2POINT,
            rotate(own.orientation, self.joint.axis) if slides else still,
            own.position,
            other.position,
            to_xyzw(own.orientation),
            to_xyzw(other.orientation),
        )
        client.changeConstraint(constraint, maxForce=_STRONGEST)
        return int(constraint)

    def remove(self) -> None:
        """Disconnect the bodies."""
        for constraint in self._constraints:
            self._client.removeConstraint(constraint)
        self._constraints = []

    # motion

    def _relative(self) -> Quaternion:
        turn = (1.0, 0.0, 0.0, 0.0) if self.parent is None else self.parent.pose.orientation
        return multiply(conjugate(turn), self.child.pose.orientation)

    @property
    def position(self) -> float:
        """Angle, rad, from -pi to pi, or displacement, m, of the child against the parent since the start."""
        if self.joint.kind == "prismatic":
            return float((self._anchor(self.child, 1) - self._anchor(self.parent, 0)) @ self._axis())
        w, *turn = multiply(self._relative(), conjugate(self._start))
        angle = 2.0 * math.atan2(float(np.dot(turn, self._frames[0][1])), w)
        return math.remainder(angle, 2.0 * math.pi)

    @property
    def rate(self) -> float:
        """Speed of ``position``, rad/s or m/s."""
        if self.joint.kind == "prismatic":
            return float((self._speed(self.child, 1) - self._speed(self.parent, 0)) @ self._axis())
        spin = np.zeros(3) if self.parent is None else np.array(self.parent.spin)
        return float((np.array(self.child.spin) - spin) @ self._axis())

    def _axis(self) -> Array:
        """Return the axis in the world."""
        axis = self._frames[0][1]
        return np.array(axis if self.parent is None else rotate(self.parent.pose.orientation, axis))

    def _anchor(self, body: Body | None, end: int) -> Array:
        place = self._frames[end][0]
        return np.array(place if body is None else compose(body.pose, Pose(place)).position)

    def _speed(self, body: Body | None, end: int) -> Array:
        if body is None:
            return np.zeros(3)
        arm = self._anchor(body, end) - np.array(body.pose.position)
        return np.array(body.velocity, float) + np.array(np.cross(body.spin, arm), float)

    def push(self, dt: float) -> None:
        """Add limits, damping and friction to the bodies' forces for the next step of ``dt``, s."""
        if self.joint.kind == "ball":
            return
        axis = self._axis()
        effort = self._effort(axis, dt)
        if effort == 0.0:
            return
        ends = ((self.child, 1.0),) if self.parent is None else ((self.child, 1.0), (self.parent, -1.0))
        for body, sign in ends:
            force = sign * effort * axis
            if self.joint.kind == "prismatic":
                _add(body.force, force)
                _add(body.torque, np.cross(np.subtract(self.child.centre, body.centre), force))
            else:
                _add(body.torque, force)

    def _effort(self, axis: Array, dt: float) -> float:
        """Return torque, N m, or force, N, on the child about or along the axis."""
        joint, rate, position = self.joint, self.rate, self.position
        stop = self._inertia(axis) / dt  # effort per speed that is stopped within a step
        effort = -rate * min(joint.damping, stop)
        if joint.friction:
            hold = -stop * (rate + _RETURN * (position - self._held) / dt) - effort
            if abs(hold) > joint.friction:
                hold, self._held = math.copysign(joint.friction, hold), position
            effort += hold
        slowest = _rate_to(joint.lower - position, dt, upper=False)
        fastest = _rate_to(joint.upper - position, dt, upper=True)
        return min(max(effort, stop * (slowest - rate)), stop * (fastest - rate))

    def _inertia(self, axis: Array) -> float:
        """Return the mass, kg, or moment of inertia, kg m^2, against which an effort moves the joint."""
        return self._slide_mass(axis) if self.joint.kind == "prismatic" else self._hinge_inertia(axis)

    def _slide_mass(self, axis: Array) -> float:
        """Return the effective mass of a slide: its bodies turn together, so that they swing as one slides.

        With the velocity x of the slide, the common spin w and the vector r between the centres of mass, the kinetic
        energy is (m |x a + w x r|^2 + w . I w) / 2, m the reduced mass; w follows without effort.
        """
        if self.parent is None:
            return self.child.mass
        mass = 1.0 / (1.0 / self.child.mass + 1.0 / self.parent.mass)
        apart = np.subtract(self.child.centre, self.parent.centre)
        arm = _cross_matrix(apart)
        inertia = np.linalg.inv(_inverse_inertia(self.child)) + np.linalg.inv(_inverse_inertia(self.parent))
        coupling = mass * np.cross(apart, axis)
        return mass - float(coupling @ np.linalg.solve(inertia - mass * arm @ arm, coupling))

    def _hinge_inertia(self, axis: Array) -> float:
        """Return the effective moment of inertia of a hinge.

        A pair of opposite torques about the axis turns both bodies and would part their anchors; a force between the
        anchors prevents that (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 8.2).
        """
        mobility, drift, turn = np.zeros((3, 3)), np.zeros(3), 0.0
        for body, end in ((self.child, 1), (self.parent, 0)):
            if body is None:
                continue
            inverse_inertia = _inverse_inertia(body)
            arm = _cross_matrix(self._anchor(body, end) - np.array(body.centre))
            spin = inverse_inertia @ axis
            mobility += np.eye(3) / body.mass - arm @ inverse_inertia @ arm
            drift -= arm @ spin
            turn += float(axis @ spin)
        return 1.0 / (turn - float(drift @ np.linalg.solve(mobility, drift)))


def _inverse_inertia(body: Body) -> Array:
    """Return the inverse (3, 3) of the inertia about the centre of mass, world axes, 1/(kg m^2)."""
    orientation = compose(body.pose, body.frame).orientation
    axes = np.array([rotate(orientation, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))])
    inverse_inertia: Array = axes.T @ np.diag(1.0 / body.moments) @ axes
    return inverse_inertia


def _cross_matrix(v: Array) -> Array:
    """Return the matrix (3, 3) of the cross product with a vector."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _rate_to(gap: float, dt: float, *, upper: bool) -> float:
    """Return the largest speed towards a limit in a step; beyond the limit it corrects a share of the excess."""
    is_beyond = gap < 0.0 if upper else gap > 0.0
    return gap / dt * (_RETURN if is_beyond else 1.0)


def swap_ends(joint: SdfJoint) -> SdfJoint:
    """Return the same joint with parent and child exchanged."""
    x, y, z = joint.axis
    return replace(joint, parent=joint.child, child=joint.parent, axis=(-x, -y, -z))


def _in_body(body: Body | None, anchor: Vector, axis: Vector) -> tuple[Vector, Vector]:
    """Return a joint's anchor and axis in the frame of a body's model."""
    if body is None:
        return anchor, axis
    back = inverse(body.pose)
    return compose(back, Pose(anchor)).position, rotate(back.orientation, axis)


def _add(total: list[float], part: Array) -> None:
    for k, value in enumerate(part.tolist()):
        total[k] += value
