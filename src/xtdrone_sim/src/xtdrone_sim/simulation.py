"""The simulator without ROS: world, sensors and autopilots of a fleet, in strict lockstep at 250 Hz.

One step: the world moves on under the last motor commands, sensors see it, the autopilots' kernels run on them and
give the next commands. So after a step truth, samples and estimates all belong to ``time_us``. Mode logic runs on its
own, slower beat between steps.
"""

from __future__ import annotations

from collections.abc import Sequence

from xtdrone_control.autopilot.autopilot import STEP_US, Autopilot
from xtdrone_control.autopilot.commander import Commander
from xtdrone_control.autopilot.parameters import Parameters
from xtdrone_control.fleet import Vehicle, spawn_grid

from .sensors import Sensors
from .vehicle_model import load_vehicle
from .world import World, load_world

COMMANDER_PERIOD_US = 100_000


class Simulation:
    """A fleet in a world.

    Attributes:
        fleet: the vehicles, in order of their global index.
        world: bodies; ``world.plant`` is the truth.
        autopilot: estimators and controllers.
        commanders: one a vehicle.
        time_us: simulated time, microseconds.
        step_us: one step.
    """

    step_us = STEP_US

    def __init__(
        self,
        fleet: tuple[Vehicle, ...],
        *,
        rows: int = 3,
        world: str = "empty",
        seed: int = 0,
        shared_datum: bool = True,
        places: Sequence[tuple[float, float, float]] | None = None,
    ) -> None:
        """Place the fleet on the ground.

        Args:
            fleet: see ``xtdrone_control.fleet.parse_fleet``.
            rows: vehicles side by side on the spawn grid.
            world: a name in ``config/worlds`` or a file.
            seed: of all sensor noise.
            shared_datum: every local frame starts at the world's origin; otherwise at each vehicle's first GPS fix.
            places: (x, y, z) m ENU a vehicle instead of the grid.

        Raises:
            ModelError: unknown vehicle type or world.
            FleetError: a bad number of rows.
        """
        model = load_world(world)
        types = {vehicle.type: load_vehicle(vehicle.type) for vehicle in fleet}
        models = [types[vehicle.type] for vehicle in fleet]
        spawn = places if places is not None else spawn_grid(fleet, rows)
        self.fleet = fleet
        self._model = model
        self._models = models
        self._spawn = spawn
        self._seed = seed
        self._datum = model.datum if shared_datum else None
        self._parameters = [
            Parameters(
                {
                    **vehicle_model.parameters,
                    "EKF2_MAG_DECL": model.declination,
                    "MAV_SYS_ID": vehicle.system_id,
                }
            )
            for vehicle, vehicle_model in zip(fleet, models, strict=True)
        ]
        self._begin(0)

    def _begin(self, time_us: int) -> None:
        """Make world, sensors and autopilots as they are at the start, at simulated time ``time_us``."""
        self.time_us = time_us
        self.world = World(self._model, self._models, self._spawn, STEP_US * 1e-6)
        self.autopilot = Autopilot([vehicle.rotor_layout for vehicle in self._models], self._datum)
        self.autopilot.time_us = time_us
        self.sensors = Sensors(self.world, self.autopilot, self._seed)
        self.commanders = []
        for vehicle, parameters in zip(self.fleet, self._parameters, strict=True):
            parameters.write_to(self.autopilot.params[vehicle.id])
            self.commanders.append(Commander(vehicle, self.autopilot, parameters, vehicle.id))
        self.autopilot.start_control()
        self._steps = 0

    def step(self) -> None:
        """Advance everything by one step."""
        autopilot = self.autopilot
        self.world.step(autopilot.control["actuators"], autopilot.setpoint["armed"])
        self.time_us += STEP_US
        self.sensors.sample(self._steps, self.time_us)
        autopilot.step()
        self._steps += 1
        if self.time_us % COMMANDER_PERIOD_US == 0:
            for commander in self.commanders:
                commander.update()

    def restart(self, time_us: int = 0) -> None:
        """Put the fleet back to its start: spawn places, disarmed, estimators, modes and noise from the beginning.

        Parameters that were changed stay changed, as they do when an autopilot is rebooted. ``world``, ``autopilot``,
        ``sensors`` and ``commanders`` are new objects.

        Args:
            time_us: simulated time from which it goes on, microseconds; a multiple of ``step_us``. From 0 the same
                inputs lead to the same flight as the first time, to the last bit.

        Raises:
            ValueError: ``time_us`` is no such multiple.
        """
        if time_us < 0 or time_us % STEP_US:
            raise ValueError(f"time: {time_us} us is not allowed, a multiple of {STEP_US} us")
        self.world.close()
        self._begin(time_us)

    def run_until(self, time_us: int) -> None:
        """Step until simulated time is at least ``time_us``."""
        while self.time_us < time_us:
            self.step()

    def close(self) -> None:
        """Free the physics engine."""
        self.world.close()
