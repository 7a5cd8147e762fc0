"""Vehicles and people of a simulation, as seen by downward-looking sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.fleet import Vehicle
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_sim.physics.vehicle_dynamics import ABSENT
from xtdrone_sim.physics.world import World
from xtdrone_sim.rays.scene import ActorInScene, SceneAt
from xtdrone_sim.vehicles.gimbals_and_landing_gears import Gimbals, LandingGears
from xtdrone_sim.vehicles.link_poses import Links
from xtdrone_sim.vehicles.vehicle_model import VehicleModel
from xtdrone_worlds.worlds.actors import Actors
from xtdrone_worlds.worlds.sdf import SdfActor

_MARGIN = 1.0  # m around a vehicle's collision box, within which all of its links are
_PERSON = 1.0, 1.5  # m: height of a person's centre, and radius of a sphere around it that contains every posture
_STEP_US = 4000  # interval over which the velocity of a person is computed

Array = NDArray[np.float64]


class Others:
    """The vehicles and people of a simulation."""

    def __init__(
        self,
        vehicles: Sequence[Vehicle | None],
        models: Sequence[VehicleModel],
        world: World,
        gimbals: Gimbals,
        gears: LandingGears,
        actors: Actors,
    ) -> None:
        """Refer to the parts of a simulation; see ``Simulation``."""
        self._vehicles, self._models, self._world = vehicles, models, world
        self._gimbals, self._gears, self._actors = gimbals, gears, actors
        self._links: Links | None = None
        self._fleet: tuple[Vehicle | None, ...] = ()

    @property
    def fleet(self) -> tuple[Vehicle | None, ...]:
        """The vehicles by index; None for a free place."""
        return tuple(self._vehicles)

    @property
    def people(self) -> Sequence[SdfActor]:
        """All people of the world."""
        return self._world.model.actors

    @property
    def any(self) -> bool:
        """Whether there is another vehicle or a person that a vehicle can see."""
        return bool(self.people) or int(np.count_nonzero(self._world.plant["contact"] < ABSENT)) > 1

    def spheres(self, time_us: int) -> tuple[Array, Array]:
        """Return centres (m, 3), m, map, and radii (m,), m, of spheres around all vehicles by index, then all people.

        Args:
            time_us: simulated time, microseconds.
        """
        plant, count = self._world.plant, len(self._world.plant)
        states = [state for _, state in self._actors.present(time_us)]
        middles, radii = np.empty((count + len(states), 3)), np.empty(count + len(states))
        middles[:count], radii[:count] = plant["position"], self._world.models["radius"] + _MARGIN
        radii[:count][plant["contact"] >= ABSENT] = -1.0
        for k, state in enumerate(states, start=count):
            middles[k], radii[k] = state.position, _PERSON[1]
            middles[k, 2] += _PERSON[0]
        return middles, radii

    def scene(self, time_us: int) -> SceneAt:
        """Return the poses of all links and people at a simulated time, microseconds."""
        if self._links is None or self._fleet != self.fleet:
            self._fleet = self.fleet
            self._links = Links([vehicle.name if vehicle else "" for vehicle in self._fleet], self._models)
        states = self._links.place(self._world.plant, self._gimbals.records, self._gears.records)
        places = zip(self._links.names, states["position"].tolist(), states["q"].tolist(), strict=True)
        links = {name: Pose(tuple(position), tuple(q)) for name, position, q in places}
        people = {
            name: ActorInScene(Pose(state.position, from_euler(0.0, 0.0, state.yaw)), state.phase)
            for name, state in self._actors.present(time_us)
        }
        return SceneAt(links, people)

    def velocities(self, time_us: int) -> dict[str, Array]:
        """Return the velocity (3,), m/s, map, of each vehicle and person by name."""
        rows = zip(self._vehicles, self._world.plant["velocity"], strict=True)
        found = {vehicle.name: velocity.astype(float) for vehicle, velocity in rows if vehicle}
        later = dict(self._actors.present(time_us + _STEP_US))
        for name, state in self._actors.present(time_us):
            found[name] = (np.array(later[name].position) - state.position) / (_STEP_US * 1e-6)
        return found
