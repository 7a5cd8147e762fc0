"""Physical content of a world's description: origin, gravity, magnetic field, wind, friction, models, people."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.geodesy.projection import Datum
from xtdrone_sim.worlds import catalogue
from xtdrone_sim.worlds.sdf import SdfActor, SdfJoint, SdfModel


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
        models: models.
        actors: moving people.
        joints: between the models.
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
    joints: tuple[SdfJoint, ...] = ()


def load_world(name: str) -> WorldModel:
    """Return the world ``name``; see ``catalogue.load_world``.

    Raises:
        ModelError: the world is unknown, a field is missing, or a value is not allowed.
    """
    world = catalogue.load_world(name)
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
        world.joints,
    )
