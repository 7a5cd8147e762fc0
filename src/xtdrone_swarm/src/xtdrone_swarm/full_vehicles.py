"""The full simulator behind the ``Vehicles`` interface: physics, sensors, estimators and autopilots in one process.

The same Leader and Follower classes that a script has tested on simplified vehicles thus fly in full physics without
ROS. The layers between them and the autopilots in the ROS stack are implemented here as function calls: the rules of
the communication node (``xtdrone_control.communication.commands``) and its 30 Hz setpoint stream, MAVROS's conversion
from ENU to NED, and PX4's interpretation of SET_POSITION_TARGET_LOCAL_NED. A command acts in the turn in which it is
given; over topics it is delayed by two or three turns more.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np

from xtdrone_autopilot.commander.commander import Result
from xtdrone_autopilot.mavlink.commands.setpoint_conversion import local_target
from xtdrone_common import frames, modes
from xtdrone_common.fleet import MAX_VEHICLES, FleetError, parse_fleet
from xtdrone_common.modes import PX4_MODES
from xtdrone_common.rotation import yaws_of
from xtdrone_control.communication.commands import HOVER_SPEED, OWN_COMMANDS, CommandRequest, MultirotorCore
from xtdrone_control.communication.setpoint import FRAME_LOCAL_NED, Setpoint
from xtdrone_coordination.patterns import origin_columns
from xtdrone_lockstep.protocol import Schedule
from xtdrone_sim.simulation import Simulation
from xtdrone_swarm.swarm_vehicles import ACCELERATION, HOLD, POSITION, VELOCITY, Array, Mask

STREAM_RATE = 30  # Hz, rate of the setpoint stream
_TO_ENU = np.array([1.0, 1.0, -1.0])

_KINDS = (HOLD, VELOCITY, ACCELERATION, POSITION)
_MODES = {mode.name: mode for mode in modes.SUPPORTED}


class CoreVehicles:
    """Vehicles in full physics, each flown by its autopilot. See ``swarm_vehicles.Vehicles`` for the attributes.

    ``position`` and ``velocity`` are the autopilot's estimates, as published on ``mavros/local_position``; NaN until
    the estimate is valid, a few tenths of a second after the start.

    Attributes:
        simulation: the simulator itself: world, sensors, autopilots.
    """

    def __init__(
        self,
        count: int = 9,
        *,
        kind: str = "iris",
        places: Sequence[tuple[float, float, float]] | Array | None = None,
        seed: int = 0,
        world: str = "empty",
        hover_speed: float = HOVER_SPEED,
        cmd_timeout: float = 0.0,
    ) -> None:
        """Place the vehicles on the ground, disarmed.

        Args:
            count: number of vehicles, 1 to 250.
            kind: vehicle type, a name in ``config/vehicles``.
            places: initial position (x, y, z) of each vehicle, m ENU; None: the spawn grid (pattern ``origin``).
            seed: seed of all sensor noise.
            world: a name in ``config/worlds``, or a file.
            hover_speed: m/s (m/s^2 for accelerations); see ``MultirotorCore``.
            cmd_timeout: s; see ``MultirotorCore``; 0: a command holds until the next one.

        Raises:
            FleetError: ``count`` is out of range.
            ModelError: unknown vehicle type or world.
            ValueError: ``places`` does not consist of ``count`` finite triples, or another value is not allowed.
        """
        if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= MAX_VEHICLES:
            raise FleetError(f"number of vehicles: {count!r} is not allowed in full physics; 1 to {MAX_VEHICLES}")
        fleet = parse_fleet(f"{kind}:{count}")
        self.simulation = Simulation(
            fleet,
            rows=origin_columns(count),
            world=world,
            seed=seed,
            places=None if places is None else _check_places(places, count),
        )
        self.names = tuple(vehicle.name for vehicle in fleet)
        self.step_us = self.simulation.step_us
        self._log = _Log()
        self._schedule = Schedule(STREAM_RATE, self.step_us)
        self._cores = [
            MultirotorCore(name, self._log, hover_speed=hover_speed, cmd_timeout=cmd_timeout) for name in self.names
        ]
        self._begin()

    def _begin(self) -> None:
        self._targets: list[tuple[Setpoint, SimpleNamespace] | None] = [None] * len(self.names)
        self._due_us = 0
        self._look()

    # the state

    def _look(self) -> None:
        """Update the vehicles' state from the simulation."""
        autopilot = self.simulation.autopilot
        estimator = autopilot.estimator
        commanders = self.simulation.commanders
        self.time_us = self.simulation.time_us
        valid = ((estimator["position_valid"] != 0) & (estimator["altitude_valid"] != 0))[:, None]
        self.position = np.where(valid, estimator["position"][:, [1, 0, 2]] * _TO_ENU, np.nan)
        self.velocity = np.where(valid, estimator["velocity"][:, [1, 0, 2]] * _TO_ENU, np.nan)
        yaw = 0.5 * math.pi - yaws_of(estimator["q"])
        self.yaw = np.arctan2(np.sin(yaw), np.cos(yaw))
        self.true_position = np.array(self.simulation.world.plant["position"])
        self._armed = [commander.armed for commander in commanders]
        self._mode = [commander.mode.name for commander in commanders]
        self.armed: Sequence[bool] = self._armed
        self.mode: Sequence[str] = self._mode
        attitudes = estimator["q"].tolist()
        for i, core in enumerate(self._cores):
            core.on_state(self.mode[i], self.armed[i])
            if valid[i]:
                w, x, y, z = frames.attitude_ned_to_enu(*attitudes[i])
                px, py, pz = self.position[i].tolist()
                core.on_pose((px, py, pz), (x, y, z, w))

    @property
    def collisions(self) -> list[str]:
        """Collisions since the start, between vehicles or with objects, as the simulator node describes them."""
        world = self.simulation.world
        names = [*self.names, *(model.name for model in world.model.models)]
        return [f"collision of {names[a]} and {names[b]}" for a, b in sorted(world.collisions)]

    @property
    def _now(self) -> float:
        return self.time_us * 1e-6

    # commands

    def command(self, index: int, text: str) -> str:
        """Send an XTDrone command to a vehicle; see ``Vehicles``. A command for the current state has no effect.

        Returns:
            The reason for a rejection, in the autopilot's words; "" if the command is accepted.

        Raises:
            IndexError: ``index`` is out of range.
        """
        self._check_index(index)
        request = self._cores[index].on_command(text, self._now)
        if request is None:
            return ""
        refusal = self._carry_out(index, request)
        self._cores[index].on_result(request, not refusal, refusal, self._now)
        commander = self.simulation.commanders[index]
        self._armed[index], self._mode[index] = commander.armed, commander.mode.name
        self._cores[index].on_state(self.mode[index], self.armed[index])
        return refusal

    def _carry_out(self, index: int, request: CommandRequest) -> str:
        commander = self.simulation.commanders[index]
        name = self.names[index]
        if request.arm is not None:
            obstacle = commander.arming_denial() if request.arm else "Not landed"
            done = commander.arm_disarm(request.arm) is Result.ACCEPTED
            word = "arming" if request.arm else "disarming"
            return "" if done else f"{name}: {word} denied: {obstacle or 'the autopilot was terminated'}"
        if request.command not in PX4_MODES:
            commands = ", ".join(OWN_COMMANDS)
            return (
                f"{name}: {request.command!r} is neither a command ({commands}) nor a PX4 mode ({', '.join(PX4_MODES)})"
            )
        mode = _MODES.get(request.command)
        if mode is None:
            return f"{name}: mode {request.command} is not supported; there are: {', '.join(_MODES)}"
        if commander.request(mode) is Result.ACCEPTED:
            return ""
        reason = commander.mode_denial(mode)
        return f"{name}: {request.command} is not available now" + (f": {reason}" if reason else "")

    def steer(self, kind: int, vectors: Array, given: Mask) -> None:
        """Set the setpoints of some vehicles; see ``Vehicles``.

        Raises:
            ValueError: unknown kind, wrong shape, or a vector that is not finite; the message names its vehicle.
        """
        _check_kind(kind)
        if vectors.shape != self.position.shape or given.shape != self.yaw.shape:
            raise ValueError(
                f"setpoints: shapes {vectors.shape} and {given.shape} are not allowed, "
                f"{self.position.shape} and {self.yaw.shape}"
            )
        for i in np.flatnonzero(given).tolist():
            x, y, z = vectors[i].tolist()
            self.steer_one(i, kind, (x, y, z))

    def steer_one(self, index: int, kind: int, vector: tuple[float, float, float], yaw_rate: float = 0.0) -> None:
        """Set one vehicle's setpoint, ENU, with a yaw rate, rad/s; a POSITION keeps the current heading.

        Raises:
            IndexError: ``index`` is out of range.
            ValueError: unknown kind, or a value that is not finite.
        """
        self._check_index(index)
        _check_kind(kind)
        if not all(map(math.isfinite, (*vector, yaw_rate))):
            raise ValueError(
                f"setpoint of {self.names[index]}: {tuple(vector)}, yaw rate {yaw_rate}: finite numbers are needed"
            )
        core = self._cores[index]
        if kind == VELOCITY:
            core.on_target_velocity("velocity", vector, yaw_rate, self._now, body=False)
        elif kind == ACCELERATION:
            core.on_target_acceleration("acceleration", vector, yaw_rate, self._now, body=False)
        elif kind == POSITION:
            half = 0.5 * float(self.yaw[index])
            core.on_target_pose("position", vector, (0.0, 0.0, math.sin(half), math.cos(half)), body=False)
        else:
            core.on_command("HOVER", self._now)

    def _check_index(self, index: int) -> None:
        if not 0 <= index < len(self.names):
            raise IndexError(f"vehicle {index} does not exist; 0 to {len(self.names) - 1}")

    # time

    def advance(self, time_us: int) -> None:
        """Advance to ``time_us``, a multiple of ``step_us``; send the setpoints at each 30 Hz turn up to then.

        Raises:
            ValueError: ``time_us`` is not such a multiple, or lies in the past.
        """
        if time_us % self.step_us or time_us < self.time_us:
            raise ValueError(
                f"time: {time_us} us is not allowed, a multiple of {self.step_us} us from {self.time_us} us on"
            )
        while self.time_us < time_us:
            if self.time_us >= self._due_us:
                self._send()
                self._due_us = self._schedule.after_us(self.time_us)
            self.simulation.run_until(min(self._due_us, time_us))
            self._look()

    def _send(self) -> None:
        """Send every autopilot its setpoint, like the stream on ``mavros/setpoint_raw/local``."""
        for i, (core, commander) in enumerate(zip(self._cores, self.simulation.commanders, strict=True)):
            setpoint = core.tick(self._now)
            known = self._targets[i]
            if known is None or known[0] is not setpoint:
                known = self._targets[i] = (setpoint, _target(setpoint))
            local_target(commander, known[1])

    def restart(self) -> None:
        """Reset all vehicles to their initial state; see ``Vehicles``. Changed parameters are kept."""
        self.simulation.restart()
        for core in self._cores:
            core.restart()
        self._begin()

    def close(self) -> None:
        """Free the physics engine."""
        self.simulation.close()


class _Log:
    """Redirects the communication node's messages to this module's log."""

    def __init__(self) -> None:
        logger = logging.getLogger(__name__)
        self.info = logger.debug
        self.warning = logger.info  # rejections are returned to the caller
        self.stream_warning = logger.warning


def _target(setpoint: Setpoint) -> SimpleNamespace:
    """Return a setpoint with the fields of SET_POSITION_TARGET_LOCAL_NED, in NED, or in FRD for a body frame."""
    local = setpoint.frame == FRAME_LOCAL_NED
    turn = frames.enu_to_ned if local else frames.flu_to_frd
    x, y, z = turn(*setpoint.position)
    vx, vy, vz = turn(*setpoint.velocity)
    afx, afy, afz = turn(*setpoint.acceleration)
    return SimpleNamespace(
        coordinate_frame=setpoint.frame,
        type_mask=setpoint.type_mask,
        x=x, y=y, z=z, vx=vx, vy=vy, vz=vz, afx=afx, afy=afy, afz=afz,
        yaw=frames.yaw_enu_to_ned(setpoint.yaw) if local else -setpoint.yaw,
        yaw_rate=-setpoint.yaw_rate,
    )  # fmt: skip


def _check_kind(kind: int) -> None:
    if kind not in _KINDS:
        raise ValueError(f"kind of setpoint: {kind!r} is not allowed, one of {_KINDS}")


def _check_places(places: Sequence[tuple[float, float, float]] | Array, count: int) -> list[tuple[float, float, float]]:
    array = np.asarray(places, dtype=float)
    if array.shape != (count, 3) or not np.isfinite(array).all():
        shape = " x ".join(map(str, array.shape))
        raise ValueError(f"places: {shape} numbers are not allowed; {count} x 3 finite ones, m ENU")
    return [(x, y, z) for x, y, z in array.tolist()]
