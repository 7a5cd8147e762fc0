"""Who flies the vehicles: the cut between the simulator and the autopilots, and our own autopilot's side of it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from xtdrone_control.autopilot.autopilot import Autopilot
from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_control.autopilot.logger.logger import Logger
from xtdrone_control.autopilot.logger.stream import LogStream
from xtdrone_control.autopilot.navigator.plan import Plans
from xtdrone_control.autopilot.parameters.parameters import Parameters
from xtdrone_control.fleet import Vehicle
from xtdrone_control.geodesy.datum import Datum
from xtdrone_sim.physics.battery import Batteries
from xtdrone_sim.physics.world import World, WorldModel
from xtdrone_sim.vehicles.vehicle_model import VehicleModel

COMMANDER_PERIOD_US = 100_000


class Autopilots(Protocol):
    """The autopilots of a simulation's vehicles.

    One step: the simulator writes ``autopilot.sensors``, calls ``step``, and lets the world go on under
    ``autopilot.motor_inputs()``.

    Attributes:
        autopilot: records of all vehicles; a new object after each ``begin``.
        commanders: modes and arming of ``served``, one a vehicle; a new list after each ``begin``, and in it a new
            object when a vehicle's autopilot alone is rebooted.
        served: the vehicles whose MAVLink the simulator serves.
        need_time: they answer their clients only while time goes on.
        descriptors: file descriptors on which something may come while time stands still; see ``serve``.
    """

    autopilot: Autopilot
    commanders: list[Commander]
    served: tuple[Vehicle, ...]
    need_time: bool
    descriptors: tuple[int, ...]

    def begin(self, world: World, time_us: int) -> None:
        """Start anew, in a new world, at simulated time ``time_us``."""

    def step(self) -> None:
        """Advance by one step over the samples in ``autopilot.sensors``."""

    def missing(self) -> str:
        """Say for whom time should not begin yet; "" for nobody."""

    def serve(self) -> None:
        """Act on what has come on ``descriptors``; returns at once."""

    def close(self) -> None:
        """Free what is held."""


class AutopilotFactory(Protocol):
    """Makes the autopilots of a fleet."""

    def __call__(
        self, fleet: tuple[Vehicle, ...], models: Sequence[VehicleModel], world: WorldModel, datum: Datum | None
    ) -> Autopilots:
        """Make them; they start with ``begin``.

        Args:
            fleet: the vehicles, in order of their global index.
            models: one a vehicle.
            world: where they fly.
            datum: the local frame's origin that all vehicles share; None lets each start at its first GPS fix.
        """


class BuiltinAutopilot:
    """Our own autopilot: kernels at every step, mode logic at 10 Hz. See ``Autopilots``."""

    need_time = False
    descriptors: tuple[int, ...] = ()

    def __init__(
        self,
        fleet: tuple[Vehicle, ...],
        models: Sequence[VehicleModel],
        world: WorldModel,
        datum: Datum | None,
        params: Path | None = None,
        logs: Path | None = None,
    ) -> None:
        """Make the vehicles' parameters and plans, which outlive a restart.

        Args:
            fleet, models, world, datum: see ``AutopilotFactory``.
            params: folder in which changed parameters outlive the simulator, a file ``<vehicle>.params`` each; None:
                every run starts with the defaults.
            logs: folder for the vehicles' logs; None writes none.
        """
        self.served = fleet
        self._logs = logs
        self._logger: Logger | None = None
        self._layouts = [model.rotor_layout for model in models]
        self._battery_models = [model.battery for model in models]
        self._datum = datum
        self._parameters = [
            Parameters(
                {
                    **model.parameters,
                    "EKF2_MAG_DECL": world.declination,
                    "MAV_SYS_ID": vehicle.system_id,
                },
                None if params is None else params / f"{vehicle.name}.params",
            )
            for vehicle, model in zip(fleet, models, strict=True)
        ]
        self._plans = [Plans() for _ in fleet]
        self.autopilot = Autopilot(self._layouts, datum)
        self.commanders: list[Commander] = []

    def begin(self, world: World, time_us: int) -> None:
        """Boot all autopilots; parameters that were changed stay changed, missions, geofences and rally points stay."""
        self.close()
        self.autopilot = Autopilot(self._layouts, self._datum)
        self.autopilot.time_us = time_us
        self.commanders = []
        for index, parameters in enumerate(self._parameters):
            parameters.write_to(self.autopilot.params[index])
            self.commanders.append(self._boot(index))
        self.autopilot.start_control()
        self._batteries = Batteries(world, self.autopilot, self._battery_models, self._parameters)
        if self._logs is not None:
            self._logger = Logger(self.autopilot, self.commanders, self._logs)
            self.autopilot.logs = self._logger.folders
            self._logger.update()

    def _boot(self, index: int) -> Commander:
        commander = Commander(self.served[index], self.autopilot, self._parameters[index], index)
        commander.navigator.restore(self._plans[index])
        commander.open_log_stream = partial(self._open_log_stream, index)
        return commander

    def _open_log_stream(self, index: int) -> LogStream | None:
        """Begin a stream of a vehicle's log; see ``Logger.open_stream``. Without log files it needs a logger first."""
        if self._logger is None:
            self._logger = Logger(self.autopilot, self.commanders, None)
        return self._logger.open_stream(index)

    def _reboot(self, index: int) -> None:
        """Boot one vehicle's autopilot anew, as MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN asks; the others fly on."""
        if self.commanders[index].armed:  # somebody was quicker
            self.commanders[index].rebooting = False
            return
        self.autopilot.reboot(index)
        commander = self.commanders[index] = self._boot(index)
        if self._logger is not None:
            self._logger.reboot(index, commander)

    def step(self) -> None:
        """Run the kernels, and the mode logic when it is due."""
        self.autopilot.step()
        beat = self.autopilot.time_us % COMMANDER_PERIOD_US == 0
        if beat:
            self._batteries.update(self.autopilot.time_us)
            for index, commander in enumerate(self.commanders):
                commander.update()
                if commander.rebooting:
                    self._reboot(index)
        if self._logger is not None:
            self._logger.step()
            if beat:
                self._logger.update()

    def missing(self) -> str:
        """Nobody is waited for."""
        return ""

    def serve(self) -> None:
        """Nothing comes from outside."""

    def close(self) -> None:
        """End the logs."""
        if self._logger is not None:
            self._logger.close()
            self._logger = None
