"""Interface between the simulator and the autopilots, and its implementation by the built-in autopilot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np

from xtdrone_autopilot.autopilot import STEP_US, Autopilot
from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.logger.logger import Logger
from xtdrone_autopilot.logger.mavlink_log_pieces import LogStream
from xtdrone_autopilot.navigator.plan import Plans
from xtdrone_autopilot.parameters.derived_records import geometry_parameters
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_common.fleet import Vehicle
from xtdrone_common.geodesy.projection import Datum
from xtdrone_sim.physics.battery_and_motor_currents import Batteries
from xtdrone_sim.physics.world import World
from xtdrone_sim.vehicles.vehicle_model import VehicleModel
from xtdrone_worlds.worlds.sdf import SdfWorld

COMMANDER_PERIOD_US = 100_000


class AutopilotBackend(Protocol):
    """The autopilots of a simulation's vehicles.

    One step: the simulator writes ``autopilot.sensors``, calls ``step``, and advances the world under
    ``autopilot.motor_inputs()``.

    Attributes:
        autopilot: records of all vehicles; a new object after each ``begin``.
        commanders: mode and arming logic, one per place of the fleet, or none at all; a new list after each ``begin``.
            The reboot of a single autopilot replaces its entry. Those of absent places do nothing.
        served: the vehicles whose MAVLink the simulator serves from the start.
        need_time: whether the autopilots answer their clients only while simulated time advances.
        descriptors: file descriptors on which data may arrive while time stands still; see ``serve``.
    """

    autopilot: Autopilot
    commanders: list[Commander]
    served: tuple[Vehicle, ...]
    need_time: bool
    descriptors: tuple[int, ...]

    def begin(self, world: World, time_us: int) -> None:
        """Boot all autopilots in a new world at simulated time ``time_us``."""

    def step(self) -> None:
        """Advance by one step over the samples in ``autopilot.sensors``."""

    def kernel_steps(self) -> int:
        """Return the number of next steps that need only ``autopilot.step_vehicle``; 0 if ``step`` is needed."""

    def count_steps(self, steps: int) -> None:
        """Count ``steps`` that other code has run with ``autopilot.step_vehicle``, and run the logic due after them.

        Args:
            steps: 1 to ``kernel_steps()``.
        """

    def check_reboot(self) -> None:
        """Check that single vehicles can be rebooted.

        Raises:
            ValueError: they cannot; the message gives the reason.
        """

    def reboot(self, index: int) -> None:
        """Reboot the autopilot of one vehicle, which is at rest; the others keep flying."""

    def check_join(self) -> None:
        """Check that vehicles can join and leave.

        Raises:
            ValueError: they cannot; the message gives the reason.
        """

    def join(self, index: int, vehicle: Vehicle, model: VehicleModel) -> None:
        """Boot the autopilot of a vehicle that has joined at an absent place, with its default parameters."""

    def leave(self, index: int) -> None:
        """Shut down the autopilot of a vehicle that leaves."""

    def missing(self) -> str:
        """Return a text on the missing autopilots, without which time must not start; "" when all are present."""

    def serve(self) -> None:
        """Process the data that has arrived on ``descriptors``, without blocking."""

    def close(self) -> None:
        """Release all resources."""


AutopilotFactory = Callable[
    [tuple[Vehicle, ...], Sequence[VehicleModel], SdfWorld, Datum | None, int], AutopilotBackend
]
"""Creates the autopilot back end of a fleet, whose ``begin`` boots its autopilots; see ``BuiltinAutopilot``."""


class BuiltinAutopilot:
    """The built-in autopilot: kernels at every step, mode logic at 10 Hz. See ``AutopilotBackend``."""

    need_time = False
    descriptors: tuple[int, ...] = ()

    def __init__(
        self,
        fleet: tuple[Vehicle, ...],
        models: Sequence[VehicleModel],
        world: SdfWorld,
        datum: Datum | None,
        reserve: int = 0,
        params: Path | None = None,
        logs: Path | None = None,
        *,
        datum_known: bool = False,
    ) -> None:
        """Create parameters and plans of the vehicles, which survive a restart.

        Args:
            fleet: the vehicles, in order of their global index.
            models: one per vehicle.
            world: the world in which they fly.
            datum: shared origin of all local frames; None: each starts at the vehicle's first GPS fix.
            reserve: number of further, absent places.
            params: folder that stores changed parameters between runs, one file ``<vehicle>.params`` per vehicle;
                None: every run starts with the defaults.
            logs: folder for the flight logs; None disables logging.
            datum_known: whether vehicles know the datum before a GPS fix, see ``Autopilot``.
        """
        self.served = fleet
        self._logs = logs
        self._logger: Logger | None = None
        self._params = params
        self._declination = world.declination
        self._absent = set(range(len(fleet), len(fleet) + reserve))
        spare = list(fleet[:1]) * reserve  # an absent place has idle records of a vehicle like the first
        models = [*models, *list(models[:1]) * reserve]
        self._vehicles = [*fleet, *spare]
        self._layouts = [model.rotor_layout for model in models]
        self._battery_models = [model.battery for model in models]
        self._datum = datum
        self._datum_known = datum_known
        self._parameters = [
            self._load_parameters(vehicle, model, None if index in self._absent else params)
            for index, (vehicle, model) in enumerate(zip(self._vehicles, models, strict=True))
        ]
        self._plans = [Plans() for _ in self._vehicles]
        self.autopilot = Autopilot(self._layouts, datum, datum_known=datum_known)
        self.commanders: list[Commander] = []

    def _load_parameters(self, vehicle: Vehicle, model: VehicleModel, folder: Path | None) -> Parameters:
        layout = model.rotor_layout
        rotors = geometry_parameters(layout.positions, layout.moment_ratios)
        own = {"EKF2_MAG_DECL": self._declination, "MAV_SYS_ID": vehicle.system_id}
        return Parameters(
            {**rotors, **model.parameters, **own}, None if folder is None else folder / f"{vehicle.name}.params"
        )

    def begin(self, world: World, time_us: int) -> None:
        """Boot all autopilots; changed parameters, missions, geofences and rally points are kept."""
        self.close()
        self.autopilot = Autopilot(self._layouts, self._datum, datum_known=self._datum_known)
        self.autopilot.time_us = time_us
        self.commanders = []
        for index, parameters in enumerate(self._parameters):
            parameters.write_to(self.autopilot.params[index])
            self.commanders.append(self._boot(index))
        self.autopilot.start_control()
        self._batteries = Batteries(world, self.autopilot, self._battery_models, self._parameters)
        if self._logs is not None:
            self._logger = self._make_logger(self._logs)
            self.autopilot.logs = self._logger.folders
            self._logger.update()

    def _make_logger(self, folder: Path | None) -> Logger:
        logger = Logger(self.autopilot, self.commanders, folder)
        for index in self._absent:
            logger.leave(index)
        return logger

    def _boot(self, index: int) -> Commander:
        commander = Commander(self._vehicles[index], self.autopilot, self._parameters[index], index)
        commander.navigator.restore(self._plans[index])
        commander.open_log_stream = partial(self._open_log_stream, index)
        return commander

    def _open_log_stream(self, index: int) -> LogStream | None:
        """Begin a stream of a vehicle's log; see ``Logger.open_stream``. Without log files it needs a logger first."""
        if self._logger is None:
            self._logger = self._make_logger(None)
        return self._logger.open_stream(index)

    def _reboot_as_commanded(self, index: int) -> None:
        """Reboot the autopilot of one vehicle after MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN."""
        if self.commanders[index].armed:  # armed after the command had been accepted
            self.commanders[index].rebooting = False
            return
        self._restart(index)

    def check_reboot(self) -> None:
        """Do nothing: all can be rebooted."""

    def reboot(self, index: int) -> None:
        """Reboot the autopilot of one vehicle with a full battery and without samples of its sensors."""
        self.autopilot.sensors[index] = np.zeros(1, self.autopilot.sensors.dtype)[0]
        self._restart(index)
        self._batteries.reset(index)

    def check_join(self) -> None:
        """Do nothing: vehicles can join and leave."""

    def join(self, index: int, vehicle: Vehicle, model: VehicleModel) -> None:
        """See ``AutopilotBackend``; stored parameters of a vehicle of this name are used."""
        self._absent.remove(index)
        self._vehicles[index], self._layouts[index] = vehicle, model.rotor_layout
        self._battery_models[index] = model.battery
        self._parameters[index] = self._load_parameters(vehicle, model, self._params)
        self._plans[index] = Plans()
        self._parameters[index].write_to(self.autopilot.params[index])
        self.autopilot.replace(index, model.rotor_layout)
        self._batteries.fit(index, model.battery)
        commander = self.commanders[index] = self._boot(index)
        if self._logger is not None:
            self._logger.join(index, commander)

    def leave(self, index: int) -> None:
        """Shut down the autopilot of a vehicle that leaves, and complete its log."""
        if self._logger is not None:
            self._logger.leave(index)
        self.autopilot.replace(index, self._layouts[index])
        self._absent.add(index)

    def _restart(self, index: int) -> None:
        self.autopilot.reboot(index)
        commander = self.commanders[index] = self._boot(index)
        if self._logger is not None:
            self._logger.reboot(index, commander)

    def step(self) -> None:
        """Run the kernels, and the mode logic every ``COMMANDER_PERIOD_US``."""
        self.autopilot.step()
        self._follow_step()

    def kernel_steps(self) -> int:
        """Return the number of steps to the next run of the mode logic; 0 with logs and motor tests."""
        if self._logger is not None or self.autopilot.motor_tests:
            return 0
        return (COMMANDER_PERIOD_US - self.autopilot.time_us % COMMANDER_PERIOD_US) // STEP_US

    def count_steps(self, steps: int) -> None:
        """See ``AutopilotBackend``."""
        self.autopilot.time_us += steps * STEP_US
        self._follow_step()

    def _follow_step(self) -> None:
        beat = self.autopilot.time_us % COMMANDER_PERIOD_US == 0
        if beat:
            self.autopilot.update_mixers()
            self._batteries.update(self.autopilot.time_us)
            for index, commander in enumerate(self.commanders):
                if index in self._absent:
                    continue
                commander.update()
                if commander.rebooting:
                    self._reboot_as_commanded(index)
        if self._logger is not None:
            self._logger.step()
            if beat:
                self._logger.update()

    def missing(self) -> str:
        """Return "": the built-in autopilots are always present."""
        return ""

    def serve(self) -> None:
        """Do nothing: the built-in autopilot has no connections of its own."""

    def close(self) -> None:
        """Close the flight logs."""
        if self._logger is not None:
            self._logger.close()
            self._logger = None
