"""Poses and velocities relative to moving frames, as Gazebo's services return and accept them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from xtdrone_control.rotation import Vector
from xtdrone_sim.shapes.pose_arithmetic import compose, conjugate, inverse, rotate
from xtdrone_sim.shapes.visual import Pose


class State(NamedTuple):
    """Motion of a rigid part.

    Attributes:
        pose: in a frame, ENU for the world.
        velocity: of its origin, m/s.
        spin: rad/s.
    """

    pose: Pose = Pose()
    velocity: Vector = (0.0, 0.0, 0.0)
    spin: Vector = (0.0, 0.0, 0.0)


STANDING = State()
"""At rest at the origin of the world."""


def seen_from(state: State, frame: State) -> State:
    """Return a state, given in the world, relative to a frame and in its axes."""
    back = conjugate(frame.pose.orientation)
    return State(
        compose(inverse(frame.pose), state.pose),
        rotate(back, _minus(state.velocity, frame.velocity)),
        rotate(back, _minus(state.spin, frame.spin)),
    )


def in_world(state: State, frame: State) -> State:
    """Return a state, given in the axes of a frame, in the world; the velocity of the frame is not added."""
    turn = frame.pose.orientation
    return State(compose(frame.pose, state.pose), rotate(turn, state.velocity), rotate(turn, state.spin))


def part_of(state: State, pose: Pose) -> State:
    """Return the state of a part fixed at ``pose`` in a body."""
    arm = rotate(state.pose.orientation, pose.position)
    sweep = np.cross(state.spin, arm).tolist()
    vx, vy, vz = state.velocity
    return State(compose(state.pose, pose), (vx + sweep[0], vy + sweep[1], vz + sweep[2]), state.spin)


def _minus(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])
