"""People as bodies for collisions with vehicles and robots: upright cylinders that follow the people.

They are driven bodies of great mass: no collision changes their path, and static bodies do not stop them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from xtdrone_common.poses import Pose
from xtdrone_common.rotation import Vector, from_euler
from xtdrone_sim.physics.contacts.start_collisions import StartError
from xtdrone_sim.physics.world import World
from xtdrone_worlds.shapes.visual import Collision, Cylinder
from xtdrone_worlds.worlds import people_meshes
from xtdrone_worlds.worlds.actors import FASTEST, Actors, ActorState
from xtdrone_worlds.worlds.sdf import SdfActor, SdfLink, SdfModel
from xtdrone_worlds.worlds.urdf import Inertial

RADIUS = 0.25
"""m: about half the breadth of shoulders."""

_CLEARANCE = 0.05  # m above the ground, so that the cylinder does not rub on it
_TOLERANCE = 0.01  # m of overlap at the start
_HEAVY = 1e5  # kg and kg m^2, as robots


class Walk:
    """The motion of a person as the drive of its body; see ``movable_bodies.Drive``."""

    yields = False
    floats = False

    def __init__(self, actors: Actors, number: int, now_us: Callable[[], int]) -> None:
        """Follow a person.

        Args:
            actors: all people.
            number: number of the person.
            now_us: returns the simulated time at the beginning of a step, microseconds.
        """
        self._actors, self._number, self._now_us = actors, number, now_us

    @property
    def is_still(self) -> bool:
        """Whether the person stands until the next command."""
        return self._actors.rests(self._number, self._now_us())

    def propose(self, dt: float) -> tuple[Pose, Vector, Vector]:
        """Return pose, mean velocity, m/s, and spin, rad/s, of a step; a script that restarts is a jump."""
        now = self._now_us()
        old, new = (self._actors.states(time)[self._number] for time in (now, now + round(dt * 1e6)))
        x, y, z = ((b - a) / dt for a, b in zip(old.position, new.position, strict=True))
        turn = math.remainder(new.yaw - old.yaw, math.tau) / dt
        if math.hypot(x, y, z) > 2.0 * FASTEST:
            x = y = z = turn = 0.0
        return pose_of(new), (x, y, z), (0.0, 0.0, turn)

    def accept(self) -> None:
        """Do nothing: the path is a function of time."""

    def block(self) -> None:
        """Do nothing: a person is never stopped."""

    def place(self, pose: Pose) -> None:
        """Do nothing: ``Actors`` has placed the person."""


def pose_of(state: ActorState) -> Pose:
    """Return the pose of a person's origin, between the feet."""
    return Pose(state.position, from_euler(0.0, 0.0, state.yaw))


class SolidPeople:
    """The bodies of all people of a world."""

    def __init__(self, world: World, actors: Actors, described: Sequence[SdfActor], now_us: Callable[[], int]) -> None:
        """Add the bodies to the world, with the numbers after those of the world's models.

        Args:
            world: world in which they walk.
            actors: their motion; notifies this object of commands from now on.
            described: all people of the world.
            now_us: returns the simulated time, microseconds.
        """
        self._world, self._actors, self._now_us = world, actors, now_us
        self._first = len(world.model.models)
        states = actors.states(now_us())
        for k, skin in enumerate(people_meshes.skins([actor.skin for actor in described])):
            model = _model(actors.names[k], people_meshes.read(skin).height)
            world.bodies.people.add(self._first + k)
            world.add_model(self._first + k, model, pose_of(states[k]), Walk(actors, k, now_us))
        actors.watch(self._follow)

    def check_starts(self, names: Sequence[str]) -> None:
        """Check that vehicles do not start inside people.

        Args:
            names: names of the vehicles by index.

        Raises:
            StartError: one does.
        """
        for k, name in enumerate(self._actors.names):
            for other, depth in self._world.overlaps(self._first + k):
                if other < len(names) and depth > _TOLERANCE:
                    raise StartError(f"{names[other]}: the start is not free: it is {depth:.2f} m inside {name!r}")

    def _follow(self, k: int) -> None:
        """Wake, move or remove the body of a person that has received a command."""
        number = self._first + k
        if number not in self._world.bodies.by_number:
            return
        if not self._actors.is_present(k):
            self._world.remove_model(number)
            return
        still = (0.0, 0.0, 0.0)
        self._world.bodies.place(number, pose_of(self._actors.states(self._now_us())[k]), still, still)


def _model(name: str, height: float) -> SdfModel:
    body = Cylinder(RADIUS, height - _CLEARANCE)
    place = Pose((0.0, 0.0, 0.5 * (height + _CLEARANCE)))
    inertial = Inertial(_HEAVY, Pose(), (_HEAVY, _HEAVY, _HEAVY, 0.0, 0.0, 0.0))
    return SdfModel(name, Pose(), False, (SdfLink("body", collisions=(Collision(body, place),), inertial=inertial),))
