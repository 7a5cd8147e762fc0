"""A world as its file describes it: surroundings, light, standing models, actors."""

from __future__ import annotations

from dataclasses import dataclass, field

from xtdrone_control.geodesy.datum import Datum
from xtdrone_sim.descriptions import ModelError
from xtdrone_sim.vehicles.visual import Collision, Pose, Vector, Visual


class SdfError(ModelError):
    """A world or model file that cannot be used; the text names file, line, element, value and what is allowed."""


@dataclass(frozen=True)
class Light:
    """The sun, and the sky.

    Attributes:
        direction: in which it shines, world ENU; not necessarily of length 1.
        diffuse: colour of what the sun lights, red, green, blue, 0..1.
        ambient: colour of what the sky lights.
        background: colour of the sky.
        shadows: whether things throw shadows.
    """

    direction: Vector = (-0.5, 0.3, -1.0)
    diffuse: Vector = (0.8, 0.8, 0.8)
    ambient: Vector = (0.4, 0.4, 0.4)
    background: Vector = (0.7, 0.8, 0.9)
    shadows: bool = True


@dataclass(frozen=True)
class SdfLink:
    """A rigid part of a model; ``pose`` in the model's frame."""

    name: str
    pose: Pose = field(default_factory=Pose)
    visuals: tuple[Visual, ...] = ()
    collisions: tuple[Collision, ...] = ()


@dataclass(frozen=True)
class SdfModel:
    """A thing that stands in the world; ``pose`` in the world's frame."""

    name: str
    pose: Pose = field(default_factory=Pose)
    static: bool = True
    links: tuple[SdfLink, ...] = ()


@dataclass(frozen=True)
class Waypoint:
    """Where an actor is at a time of its script, s; ``pose`` of the point between its feet, in the world's frame."""

    time: float
    pose: Pose


@dataclass(frozen=True)
class Trajectory:
    """An actor's way.

    Attributes:
        waypoints: at least one, in order of their times.
        loop: begin anew after the last one.
        delay_start: s of simulated time before it begins.
        auto_start: false: it stands at its first waypoint until somebody moves it.
    """

    waypoints: tuple[Waypoint, ...]
    loop: bool = True
    delay_start: float = 0.0
    auto_start: bool = True


@dataclass(frozen=True)
class SdfActor:
    """A person.

    Attributes:
        name: unique among models and actors.
        skin: name of the person that it looks like; empty: any.
        pose: of the point between its feet while nothing moves it, x ahead, world.
        trajectory: where it walks; None: it stands.
        speed: m/s at which it walks when it is sent somewhere and nobody says how fast.
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
        name: as its file calls it.
        datum: WGS84 position of the map frame's origin.
        gravity: m/s^2, down.
        wind: m/s, ENU.
        magnetic_field: gauss, ENU.
        declination: of the magnetic field, degrees east.
        friction, restitution: of ground and models.
        light: sun and sky.
        models: what stands there.
        actors: people.
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
