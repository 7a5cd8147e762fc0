"""The content of a world file: environment, light, models, actors."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from xtdrone_common.geodesy.projection import Datum
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import Vector
from xtdrone_worlds.descriptions import ModelError
from xtdrone_worlds.shapes.visual import Collision, Visual
from xtdrone_worlds.worlds.urdf import Inertial


class SdfError(ModelError):
    """An invalid world or model file; the message names file, line, element, value and what is allowed."""


@dataclass(frozen=True)
class Light:
    """Sun and sky; colours are red, green, blue in 0..1.

    Attributes:
        direction: direction of the sunlight, world ENU, any length.
        diffuse: colour of sunlight.
        ambient: colour of skylight.
        background: colour of the sky.
        shadows: whether objects cast shadows.
    """

    direction: Vector = (-0.5, 0.3, -1.0)
    diffuse: Vector = (0.8, 0.8, 0.8)
    ambient: Vector = (0.4, 0.4, 0.4)
    background: Vector = (0.7, 0.8, 0.9)
    shadows: bool = True


DEFAULT_INERTIAL = Inertial(1.0, Pose(), (1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
"""The mass of a link without <inertial>, as in Gazebo: 1 kg and 1 kg m^2 about each axis."""


@dataclass(frozen=True)
class SdfLink:
    """A rigid part of a model.

    Attributes:
        name: unique in its model.
        pose: pose in the model frame.
        visuals, collisions: shapes.
        inertial: mass; None: ``DEFAULT_INERTIAL``.
        gravity: whether it has weight.
    """

    name: str
    pose: Pose = field(default_factory=Pose)
    visuals: tuple[Visual, ...] = ()
    collisions: tuple[Collision, ...] = ()
    inertial: Inertial | None = None
    gravity: bool = True


@dataclass(frozen=True)
class SdfModel:
    """An object in the world.

    Attributes:
        name: unique in its world.
        pose: initial pose in the world frame.
        static: if false, the model falls and can be pushed: one rigid body with all its links.
        links: rigid parts.
    """

    name: str
    pose: Pose = field(default_factory=Pose)
    static: bool = True
    links: tuple[SdfLink, ...] = ()


@dataclass(frozen=True)
class SdfJoint:
    """A joint between two models, or a model and the world.

    Attributes:
        name: unique in its model.
        kind: "revolute", "continuous", "prismatic" or "ball".
        parent, child: names of models; the parent may be "world".
        anchor: place of the joint at the models' initial poses, m, world.
        axis: unit vector of rotation or translation at the initial poses, world.
        lower, upper: limits of the child's motion against the parent, rad or m, 0 at the initial poses.
        damping: N m s/rad or N s/m.
        friction: torque or force of Coulomb friction, N m or N.
    """

    name: str
    kind: str
    parent: str
    child: str
    anchor: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    lower: float = -math.inf
    upper: float = math.inf
    damping: float = 0.0
    friction: float = 0.0


@dataclass(frozen=True)
class Waypoint:
    """Pose of an actor's point between the feet, in the world frame, at a time of its script, s."""

    time: float
    pose: Pose


@dataclass(frozen=True)
class Trajectory:
    """Path of an actor.

    Attributes:
        waypoints: at least one, in chronological order; at the second of two equal times the actor jumps.
        loop: whether to restart after the last waypoint.
        delay_start: simulated time before the start, s.
        auto_start: if false, the actor stands at its first waypoint until a command moves it.
    """

    waypoints: tuple[Waypoint, ...]
    loop: bool = True
    delay_start: float = 0.0
    auto_start: bool = True


@dataclass(frozen=True)
class SdfActor:
    """A person in the world.

    Attributes:
        name: name, unique among models and actors.
        skin: name of the appearance; empty for any.
        pose: initial pose of the point between the feet, x forward, world frame.
        trajectory: path; None for a standing actor.
        speed: default walking speed of commands, m/s.
    """

    name: str
    skin: str = ""
    pose: Pose = field(default_factory=Pose)
    trajectory: Trajectory | None = None
    speed: float = 1.0


@dataclass(frozen=True)
class SdfWorld:
    """A world.

    Attributes:
        name: name of the world in its file.
        datum: WGS84 position of the map frame's origin.
        gravity: gravitational acceleration, downwards, m/s^2.
        wind: wind velocity, ENU, m/s.
        magnetic_field: magnetic flux density, ENU, gauss.
        declination: magnetic declination, degrees east.
        friction, restitution: contact coefficients of ground and models.
        light: sun and sky.
        models: objects.
        actors: people.
        joints: between the models.
    """

    name: str
    datum: Datum
    gravity: float
    wind: Vector
    magnetic_field: Vector
    declination: float
    friction: float
    restitution: float
    light: Light = field(default_factory=Light)
    models: tuple[SdfModel, ...] = ()
    actors: tuple[SdfActor, ...] = ()
    joints: tuple[SdfJoint, ...] = ()
