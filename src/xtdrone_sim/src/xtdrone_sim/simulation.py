"""The simulator without ROS: world, sensors and autopilots of a fleet, in strict lockstep at 250 Hz.

One step: the world advances under the last motor commands, the sensors sample it, and the autopilots process the
samples and compute the next commands. After a step, truth, samples and estimates therefore all belong to ``time_us``.
``autopilots`` contains the autopilot back ends: the built-in autopilot and external PX4s.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace

from xtdrone_autopilot.autopilot import STEP_US, Autopilot
from xtdrone_autopilot.commander.commander import Commander
from xtdrone_common.fleet import StartPose, Vehicle, place_ids, start_poses, vehicle_named
from xtdrone_common.rotation import Vector
from xtdrone_sim.autopilots.builtin_autopilot import AutopilotFactory, BuiltinAutopilot
from xtdrone_sim.physics.bodies.solid_people import SolidPeople
from xtdrone_sim.physics.contacts.start_collisions import StartError
from xtdrone_sim.physics.world import World
from xtdrone_sim.sensors.sensor_models import Sensors
from xtdrone_sim.sensors.vehicles_and_people_below import Others
from xtdrone_sim.steps_in_free_flight import FreeFlight
from xtdrone_sim.vehicles.gimbals_and_landing_gears import Gimbals, LandingGears
from xtdrone_sim.vehicles.vehicle_model import VehicleModel, load_vehicle
from xtdrone_worlds.worlds.actors import actors_of
from xtdrone_worlds.worlds.catalogue import load_world

from .effects import Effect, Effects

_log = logging.getLogger("rosout.simulation")  # a child of ROS's logger, see ``xml_elements``

STRONGEST_WIND = 100.0
"""Greatest wind speed that a request may set, m/s."""


class Simulation:
    """A fleet in a world.

    Attributes:
        vehicles: vehicles by index; None for a free place. Places are those of the fleet and the reserved ones.
        models: one per place; for a free one, that of its last vehicle, or of the first vehicle.
        world: rigid bodies; ``world.plant`` is the ground truth.
        gimbals: camera gimbals of all vehicles.
        landing_gears: landing gears of all vehicles.
        effects: forces and torques added to those of the rotors; None without effects.
        actors: people, with their states at any time.
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
        reserve: int = 0,
        solid_people: bool = False,
    ) -> None:
        """Place the fleet on the ground.

        Args:
            fleet: see ``xtdrone_common.fleet.parse_fleet``.
            rows: number of vehicles side by side on the spawn grid.
            world: name or file, see ``catalogue.find_world``.
            seed: seed of all sensor noise.
            shared_datum: whether all local frames share the world's origin; otherwise each starts at the vehicle's
                first GPS fix.
            places: (x, y, z) of each vehicle's start, m ENU; replaces the poses of the fleet and the grid.
            autopilots: factory of the autopilot back end.
            effects: forces and torques on the vehicles in addition to those of rotors and drag, see ``effects``.
            reserve: number of places for vehicles that join later, see ``add_vehicle``.
            solid_people: whether vehicles and robots collide with people.

        Raises:
            EffectError: an effect cannot be applied.
            ModelError: a vehicle's model or the world is unknown.
            ValueError: a person's skin is unknown.
            FleetError: the number of rows is invalid.
            StartError: a vehicle would start below the ground, in an obstacle or in another vehicle.
        """
        model = load_world(world)
        known = {model: load_vehicle(model) for model in dict.fromkeys(vehicle.model for vehicle in fleet)}
        models = [known[vehicle.model] for vehicle in fleet]
        poses = start_poses(fleet, rows) if places is None else [StartPose(*place) for place in places]
        self.vehicles: list[Vehicle | None] = [*fleet, *[None] * reserve]
        self._ids = place_ids(fleet, reserve)
        self._joins: dict[int, int] = {}  # number of vehicles that have joined at a place
        self._model = model
        self.models = [*models, *[models[0]] * reserve]
        self._poses = [*poses, *[StartPose(0.0, 0.0)] * reserve]
        self._seed = seed
        self._rows = rows
        self._instance, self._ports = fleet[0].instance, fleet[0].ports
        self.effects = Effects(effects) if effects else None
        self.actors = actors_of(model.actors)
        self._solid_people = solid_people
        self._bodies_of_people: SolidPeople | None = None
        self.autopilots = autopilots(fleet, models, model, model.datum if shared_datum else None, reserve)
        self._begin(0)
        try:
            self._check_starts()
        except StartError:
            self.close()
            raise

    def _check_starts(self) -> None:
        self.world.check_starts(self.names)
        if self._bodies_of_people is not None:
            self._bodies_of_people.check_starts(self.names)

    def _begin(self, time_us: int) -> None:
        """Create world, sensors and autopilots in their initial state at simulated time ``time_us``."""
        self.time_us = time_us
        absent = [index for index, vehicle in enumerate(self.vehicles) if vehicle is None]
        self.world = World(self._model, self.models, self._poses, STEP_US * 1e-6, self.effects, absent)
        if self.effects is not None:
            self.effects.begin(self.world.plant, self.world.models, time_us=time_us, step_us=STEP_US, seed=self._seed)
        self.autopilots.begin(self.world, time_us)
        self.actors.restart(time_us)
        if self._solid_people:
            self._bodies_of_people = SolidPeople(self.world, self.actors, self._model.actors, lambda: self.time_us)
        self.gimbals = Gimbals(self.models)
        self.landing_gears = LandingGears(self.models)
        others = Others(self.vehicles, self.models, self.world, self.gimbals, self.landing_gears, self.actors)
        self.sensors = Sensors(self.world, others, self.autopilot, self._seed, self._joins)
        for index in absent:
            self.gimbals.fit(index, None)
            self.landing_gears.fit(index, None)
        self._free_flight: FreeFlight | None = None
        self._choose_free_flight()
        self._steps = 0

    def _choose_free_flight(self) -> None:
        """Prepare compiled steps of the whole fleet, if no effect, gimbal or landing gear needs every step."""
        plain = self.effects is None and not self.gimbals.any and not self.landing_gears.any
        if not plain:
            self._free_flight = None
        elif self._free_flight is None or self._free_flight.sensors is not self.sensors:
            self._free_flight = FreeFlight(self.world, self.sensors, self.autopilot)

    @property
    def fleet(self) -> tuple[Vehicle, ...]:
        """The vehicles in the world, in order of their index."""
        return tuple(vehicle for vehicle in self.vehicles if vehicle is not None)

    @property
    def names(self) -> list[str]:
        """Names of the vehicles by index; "" for a free place."""
        return [vehicle.name if vehicle is not None else "" for vehicle in self.vehicles]

    @property
    def local_ports(self) -> list[int]:
        """UDP ports of the autopilots' MAVLink, those of free places included."""
        numbers = enumerate(self._ids)
        places = [Vehicle("place", index, one, self._instance, ports=self._ports) for index, one in numbers]
        return [
            port for one in places for port in (one.offboard_local_port, one.gcs_local_port, one.payload_local_port)
        ]

    def add_vehicle(self, name: str, model: str = "", pose: StartPose | None = None) -> int:
        """Add a vehicle, disarmed on the ground, with an autopilot that boots now; others are not affected.

        Args:
            name: such as ``iris_9``; it begins with the type.
            model: name or file of its description; "": the type.
            pose: start pose; None: the vehicle's place on the spawn grid.

        Returns:
            Its index. The place gives its MAVLink id and ports.

        Raises:
            ValueError: the name is taken or not allowed, no place is free, the model is unknown (ModelError), the pose
                is not free (StartError), or autopilots cannot join; nothing has changed then.
        """
        self.autopilots.check_join()
        if name in self.names:
            raise ValueError(f"name: {name!r} is already in the simulation")
        free = [index for index, vehicle in enumerate(self.vehicles) if vehicle is None]
        if not free:
            raise ValueError(
                f"no place is free: {len(self.vehicles)} vehicles are in the simulation; reserve:=N keeps N more places"
            )
        named = vehicle_named(name, self._ids[free[0]], self._instance, model)
        vehicle = replace(named, ports=self._ports)
        index, description = free[0], load_vehicle(vehicle.model)
        place = pose or start_poses([*self.fleet, vehicle], self._rows)[-1]
        names = self.names
        names[index] = name
        self.world.add_vehicle(index, description, place, names)
        self.vehicles[index], self.models[index], self._poses[index] = vehicle, description, place
        self._joins[index] = self._joins.get(index, 0) + 1
        self.autopilots.join(index, vehicle, description)
        self.sensors.add_vehicle(index, self._joins[index])
        self._refit(index, description)
        return index

    def remove_vehicle(self, index: int) -> None:
        """Remove a vehicle from the world, in flight or not; its place is then free, and the others are not affected.

        Raises:
            ValueError: autopilots cannot leave, or it is the only vehicle.
        """
        self.autopilots.check_join()
        if len(self.fleet) == 1:
            raise ValueError(f"{self.names[index]} is the only vehicle in the simulation and cannot leave")
        self.world.remove_vehicle(index)
        self.autopilots.leave(index)
        self.sensors.remove_vehicle(index)
        self.vehicles[index] = None
        self._refit(index, None)

    def _refit(self, index: int, model: VehicleModel | None) -> None:
        self.gimbals.fit(index, model)
        self.landing_gears.fit(index, model)
        self._choose_free_flight()

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
        if self.world.lost:
            self._report_losses()

    def _report_losses(self) -> None:
        """Log the vehicles that have been taken out of the world, and stop their motors."""
        for index in self.world.lost:
            x, y, z = self.world.plant["position"][index].tolist()
            _log.error(
                "simulator: %s is out of the world, because its motion was not finite, or beyond the limits: it "
                "stays at (%.4g, %.4g, %.4g) m, without collisions, until it is reset",
                self.names[index],
                x,
                y,
                z,
            )
            if self.commanders:
                self.commanders[index].arm_disarm(False, force=True)
        self.world.lost.clear()

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
        """Reset one vehicle, disarmed, with its autopilot rebooted; the others are not affected.

        Changed parameters and uploaded plans are kept, as in a reboot. Sensor noise continues.

        Args:
            index: index of the vehicle.
            pose: its new pose; None: its start pose.

        Raises:
            ValueError: the place is not free (StartError), or the autopilot cannot be rebooted; nothing has changed
                then.
        """
        self.autopilots.check_reboot()
        self.world.put(index, pose or self._poses[index], self.names)
        self.autopilots.reboot(index)
        self.gimbals.reset(index)
        self.landing_gears.reset(index)

    def set_wind(self, velocity: Vector) -> None:
        """Set the world's wind until the next restart, which restores the wind of the world's file.

        Args:
            velocity: m/s, ENU, at most ``STRONGEST_WIND``.

        Raises:
            ValueError: the velocity is not finite or too large; nothing has changed then.
        """
        speed = math.hypot(*velocity)
        if not speed <= STRONGEST_WIND:
            x, y, z = velocity
            raise ValueError(f"wind: ({x:g}, {y:g}, {z:g}) m/s is not allowed, at most {STRONGEST_WIND:g} m/s")
        self.world.set_wind(velocity)

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
        if self.world.lost:
            self._report_losses()
        return True

    def close(self) -> None:
        """Release the resources of the autopilots and the physics engine."""
        self.autopilots.close()
        self.world.close()
