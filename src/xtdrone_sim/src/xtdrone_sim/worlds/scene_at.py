"""Poses of the moving things in a world at one time, for cameras and rays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from xtdrone_sim.shapes.visual import Pose


@dataclass(frozen=True)
class ActorState:
    """State of an actor.

    Attributes:
        pose: point between its feet, x ahead, world.
        phase: phase of its walk, cycles; negative: it stands.
    """

    pose: Pose
    phase: float = -1.0


@dataclass(frozen=True)
class SceneAt:
    """Poses of all moving objects at one time.

    Attributes:
        links: pose in the world by Gazebo's name of the link (model::link).
        actors: states by name.
    """

    links: Mapping[str, Pose]
    actors: Mapping[str, ActorState]
