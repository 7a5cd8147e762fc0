"""The simulator without ROS: world, sensors and autopilots of a fleet, in strict lockstep at 250 Hz.

One step: the world advances under the last motor commands, the sensors sample it, and the autopilots process the
samples and compute the next commands. After a step, truth, samples and estimates therefore all belong to ``time_us``.
``autopilots`` contains the autopilot back ends: the built-in autopilot and external PX4s.
"""

from __future__ import annotations

from collections.abc import Sequence

from xtdrone_control.autopilot.autopilot import STEP_US, Autopilot
from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_control.fleet import StartPose, Vehicle, start_poses
from xtdrone_sim.autopilots.backend import AutopilotFactory, BuiltinAutopilot
from xtdrone_sim.physics.starts import StartError
from xtdrone_sim.physics.world import World, load_world
from xtdrone_sim.sensors.sensor_models import Sensors
from xtdrone_sim.vehicles.gimbal import Gimbals
from xtdrone_sim.vehicles.landing_gear import LandingGears
from xtdrone_sim.vehicles.vehicle_model import load_vehicle

from .effects import Effect, Effects
from .free_flight import FreeFlight


class Simulation:
    """A fleet in a world.

    Attributes:
        fleet: the vehicles, in order of their global index.
        models: one per vehicle.
        world: rigid bodies; ``world.plant`` is the ground truth.
        gimbals: camera gimbals of all vehicles.
        landing_gears: landing gears of all vehicles.
        effects: forces and torques added to those of the rotors; None without effects.
        autopilots: autopilot back end of the fleet.
        time_us: simulated time, microseconds.
        step_us: length of a step, microseconds.
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
        autopilots: AutopilotFactory = BuiltinAutopilot,
        effects: Sequence[Effect] = (),
    ) -> None:
        """Place the fleet on the ground.

        Args:
            fleet: see ``xtdrone_control.fleet.parse_fleet``.
            rows: number of vehicles side by side on the spawn grid.
            world: name or file, see ``sdf.load_world_file``.
            seed: seed of all sensor noise.
            shared_datum: whether all local frames share the world's origin; otherwise each starts at the vehicle's
                first GPS fix.
            places: (x, y, z) of each vehicle's start, m ENU; replaces the poses of the fleet and the grid.
            autopilots: factory of the autopilot back end.
            effects: forces and torques on the vehicles in addition to those of rotors and drag, see ``effects``.

        Raises:
            EffectError: an effect cannot be applied.
            ModelError: a vehicle's model or the world is unknown.
            FleetError: the number of rows is invalid.
            StartError: a vehicle would start below the ground, in an obstacle or in another vehicle.
        """
        model = load_world(world)
        known = {vehicle.model: load_vehicle(vehicle.model) for vehicle in fleet}
        models = [known[vehicle.model] for vehicle in fleet]
        poses = start_poses(fleet, rows) if places is None else [StartPose(*place) for place in places]
        self.fleet = fleet
        self._model = model
        self.models = models
        self._poses = poses
        self._seed = seed
        self.effects = Effects(effects) if effects else None
        self.autopilots = autopilots(fleet, models, model, model.datum if shared_datum else None)
        self._begin(0)
        try:
            self.world.check_starts([vehicle.name for vehicle in fleet])
        except StartError:
            self.close()
            raise

    def _begin(self, time_us: int) -> None:
        """Create world, sensors and autopilots in their initial state at simulated time ``time_us``."""
        self.time_us = time_us
        self.world = World(self._model, self.models, self._poses, STEP_US * 1e-6, self.effects)
        if self.effects is not None:
            self.effects.begin(self.world.plant, self.world.models, time_us=time_us, step_us=STEP_US, seed=self._seed)
        self.autopilots.begin(self.world, time_us)
        self.sensors = Sensors(self.world, self.autopilot, self._seed)
        self.gimbals = Gimbals(self.models)
        self.landing_gears = LandingGears(self.models)
        self._free_flight = None
        if self.effects is None and not self.gimbals.any and not self.landing_gears.any:
            self._free_flight = FreeFlight(self.world, self.sensors, self.autopilot)
        self._steps = 0

    @property
    def autopilot(self) -> Autopilot:
        """State records of all autopilots; estimates and setpoints are filled by the built-in autopilot only."""
        return self.autopilots.autopilot

    @property
    def commanders(self) -> list[Commander]:
        """Mode and arming logic, one per vehicle that the built-in autopilot flies."""
        return self.autopilots.commanders

    def step(self) -> None:
        """Advance everything by one step."""
        autopilot = self.autopilots.autopilot
        commands, powered = autopilot.motor_inputs()
        if self.sensors.failing.any:
            commands = self.sensors.failing.motors(commands)
        self.world.step(commands, powered)
        self.time_us += STEP_US
        self.sensors.sample(self._steps, self.time_us)
        self.autopilots.step()
        if self.gimbals.any:
            self.gimbals.step(self._steps, self.world.plant, self.commanders, self.world.time_step)
        self.landing_gears.step(self._steps, self.commanders, self.world.time_step)
        self._steps += 1

    def restart(self, time_us: int = 0) -> None:
        """Return the fleet to its spawn positions, disarmed, with estimators, modes and noise reinitialised.

        Changed parameters keep their values, as in a reboot of an autopilot. ``world``, ``autopilot``, ``sensors``,
        ``gimbals``, ``landing_gears`` and ``commanders`` are new objects.

        Args:
            time_us: simulated time after the restart, microseconds; a multiple of ``step_us``. From 0, the same
                inputs reproduce the first flight bit for bit.

        Raises:
            ValueError: ``time_us`` is negative or not a multiple of ``step_us``.
        """
        if time_us < 0 or time_us % STEP_US:
            raise ValueError(f"time: {time_us} us is not allowed, a multiple of {STEP_US} us")
        self.world.close()
        self._begin(time_us)

    def reset_vehicle(self, index: int, pose: StartPose | None = None) -> None:
        """Put one vehicle back, disarmed, with its autopilot rebooted; the others are not affected.

        Changed parameters and uploaded plans are kept, as in a reboot. Sensor noise continues.

        Args:
            index: of the vehicle.
            pose: where it then stands; None: where it started.

        Raises:
            ValueError: the place is not free (StartError), or the autopilot cannot be rebooted; nothing has changed
                then.
        """
        self.autopilots.check_reboot()
        self.world.put(index, pose or self._poses[index], [vehicle.name for vehicle in self.fleet])
        self.autopilots.reboot(index)
        self.gimbals.reset(index)
        self.landing_gears.reset(index)

    def run_until(self, time_us: int) -> None:
        """Step until simulated time is at least ``time_us``."""
        while self.time_us < time_us:
            if not self._fly_free((time_us - self.time_us + STEP_US - 1) // STEP_US):
                self.step()

    def _fly_free(self, most: int) -> bool:
        """Advance by 1 to ``most`` steps at once; return whether that was possible."""
        most = min(most, self.autopilots.kernel_steps())
        if self._free_flight is None or most < 1:
            return False
        steps = self._free_flight.advance(most, self._steps, self.time_us)
        if steps < 1:
            return False
        self.time_us += steps * STEP_US
        self._steps += steps
        self.autopilots.count_steps(steps)
        return True

    def close(self) -> None:
        """Release the resources of the autopilots and the physics engine."""
        self.autopilots.close()
        self.world.close()
