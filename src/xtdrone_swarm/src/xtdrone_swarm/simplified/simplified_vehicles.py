"""Simplified vehicles behind the interface ``swarm_vehicles.Vehicles``; see also simplified_autopilot."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from xtdrone_common.modes import PX4_MODES
from xtdrone_common.rotation import wrap_pi
from xtdrone_control.communication.commands import HOVER_SPEED, HOVER_YAW_RATE, OWN_COMMANDS
from xtdrone_coordination.patterns import PITCH, origin_columns
from xtdrone_swarm.simplified import simplified_autopilot
from xtdrone_swarm.simplified.kinematics import VEHICLE, advance, capture, set_at, set_many
from xtdrone_swarm.simplified.vehicle_parameters import Model, load_model
from xtdrone_swarm.swarm_vehicles import ACCELERATION, HOLD, POSITION, VELOCITY, Array, Mask

STEP_US = 4000

_KINDS = (HOLD, VELOCITY, ACCELERATION, POSITION)
_SUCCESSORS = {"AUTO.TAKEOFF": "AUTO.LOITER"}  # modes entered automatically when the commanded one is complete


class SimplifiedVehicles:
    """Any number of vehicles of first or second order. See ``swarm_vehicles.Vehicles`` for the attributes.

    The layers between commands and setpoints in the ROS stack are included, like ``MultirotorCore``: HOVER and the
    dead zone, which capture the current position. The array objects stay the same; their contents change with time.

    Attributes:
        model: parameters of the vehicles.
    """

    def __init__(
        self,
        count: int,
        *,
        kind: str = "iris",
        model: Model | str | None = None,
        places: ArrayLike | None = None,
        headings: ArrayLike | None = None,
        airborne: bool = False,
        rate_step_us: int = STEP_US,
        hover_speed: float | None = HOVER_SPEED,
    ) -> None:
        """Create the vehicles at their initial positions.

        Args:
            count: number of vehicles, at least 1.
            kind: vehicle type, a name in ``config/vehicles``.
            model: see ``vehicle_parameters.load_model``.
            places: initial positions, shape (count, 3), m ENU, z at least 0; None: the spawn grid (pattern ``origin``).
            headings: initial yaw, shape (count,), rad from east, counter-clockwise; None: all look east.
            airborne: start armed, in OFFBOARD and holding position, instead of disarmed.
            rate_step_us: base step, microseconds, at least 100.
            hover_speed: dead zone, m/s (m/s^2 for accelerations), 0 or more: a velocity that exceeds it on no axis
                means HOVER; None: no dead zone.

        Raises:
            ValueError: a value is not allowed; ModelError, a subclass, for ``kind`` and ``model``.
        """
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise ValueError(f"number of vehicles: {count!r} is not allowed, at least 1")
        if isinstance(rate_step_us, bool) or not isinstance(rate_step_us, int) or rate_step_us < 100:
            raise ValueError(f"base step: {rate_step_us!r} us is not allowed, a whole number of at least 100")
        if hover_speed is not None and not 0.0 <= hover_speed < math.inf:
            raise ValueError(f"hover_speed: {hover_speed} m/s is not allowed, 0 or more, or None")
        self.names = tuple(f"{kind}_{i}" for i in range(count))
        self.model = load_model(kind, model)
        self.step_us = rate_step_us
        self._dead_zone = -1.0 if hover_speed is None else float(hover_speed)
        self._places = spawn_places(count) if places is None else check_places(places, count)
        self._headings = np.zeros(count) if headings is None else check_headings(headings, count)
        self._airborne = airborne
        self._record = self.model.record(rate_step_us)
        depth = int(self._record["delay"].max()) + 1
        self._vehicles = np.zeros(count, VEHICLE)
        self._each = self._vehicles.view(np.recarray)  # single vehicles with attribute access; slower
        self._delayed = np.zeros((count, depth, 4))
        self.position = np.zeros((count, 3))
        self.velocity = np.zeros((count, 3))
        self.yaw = np.zeros(count)
        self.true_position = self.position
        self.restart()

    def restart(self) -> None:
        """Reset all vehicles to their initial state; see ``Vehicles``."""
        vehicles = self._vehicles
        vehicles[:] = np.zeros(1, VEHICLE)[0]
        vehicles["position"] = vehicles["place"] = vehicles["home"] = vehicles["setpoint"] = self._places
        vehicles["yaw"] = self._headings
        vehicles["mode"] = simplified_autopilot.OFFBOARD if self._airborne else simplified_autopilot.LOITER
        vehicles["armed"] = vehicles["flown"] = self._airborne
        vehicles["kind"] = HOLD
        vehicles["sp_yaw"] = math.nan
        vehicles["wanted_kind"] = VELOCITY
        self._delayed[:] = (0.0, 0.0, 0.0, VELOCITY)
        self._last = [""] * len(self.names)
        self.time_us = 0
        self.position[:] = self._places
        self.velocity[:] = 0.0
        self.yaw[:] = self._headings
        self._look()

    def reset(self, index: int, place: Sequence[float] | None = None, heading: float | None = None) -> None:
        """Put one vehicle back, on the ground and disarmed; the others are not affected.

        Args:
            index: Index of the vehicle.
            place: where it then stands, (x, y, z), m ENU; None: where it started, in its initial state.
            heading: rad; None: the initial one.
        """
        v = self._vehicles[index : index + 1]
        v[:] = np.zeros(1, VEHICLE)[0]
        airborne = self._airborne and place is None
        where = self._places[index] if place is None else np.array(place, float)
        v["position"] = v["place"] = v["home"] = v["setpoint"] = where
        v["yaw"] = self._headings[index] if heading is None else wrap_pi(heading)
        v["mode"] = simplified_autopilot.OFFBOARD if airborne else simplified_autopilot.LOITER
        v["armed"] = v["flown"] = airborne
        v["kind"] = HOLD
        v["sp_yaw"] = math.nan
        v["wanted_kind"] = VELOCITY
        self._delayed[index] = (0.0, 0.0, 0.0, VELOCITY)
        self._last[index] = ""
        self.position[index], self.velocity[index], self.yaw[index] = where, 0.0, v["yaw"][0]
        self._look()

    def _look(self) -> None:
        """Update modes and arming states, which change rarely."""
        self._armed = [bool(armed) for armed in self._vehicles["armed"].tolist()]
        self._mode = [simplified_autopilot.MODE_NAMES[mode] for mode in self._vehicles["mode"].tolist()]
        self.armed: Sequence[bool] = self._armed
        self.mode: Sequence[str] = self._mode

    # commands

    def command(self, index: int, text: str) -> str:
        """Send an XTDrone command to a vehicle; see ``Vehicles``. A command for the current state has no effect.

        Returns:
            The reason for a rejection; "" if the command is accepted.

        Raises:
            IndexError: ``index`` is out of range.
        """
        if not 0 <= index < len(self.names):
            raise IndexError(f"vehicle {index} does not exist; 0 to {len(self.names) - 1}")
        if text == self._last[index] and self._holds(index, text):
            return ""
        self._last[index] = text
        if text == "HOVER":
            capture(self._each[index])
            return ""
        refusal = self._carry_out(index, text)
        vehicle = self._each[index]
        self._armed[index], self._mode[index] = bool(vehicle.armed), simplified_autopilot.MODE_NAMES[vehicle.mode]
        return f"{self.names[index]}: {refusal}" if refusal else ""

    def _holds(self, index: int, text: str) -> bool:
        if text == "HOVER":
            return bool(self._vehicles[index]["hovering"])
        if text in ("ARM", "DISARM"):
            return self.armed[index] == (text == "ARM")
        return self.mode[index] in (text, _SUCCESSORS.get(text))

    def _carry_out(self, index: int, text: str) -> str:
        vehicle = self._each[index]
        if text == "ARM":
            return self._arm(vehicle)
        if text == "DISARM":
            if vehicle.armed and vehicle.position[2] > 0.0:
                return "disarming denied: the vehicle is flying"
            simplified_autopilot.disarm(vehicle)
            return ""
        if text not in PX4_MODES:
            return f"{text!r} is neither a command ({', '.join(OWN_COMMANDS)}) nor a PX4 mode ({', '.join(PX4_MODES)})"
        if text not in simplified_autopilot.MODE_NAMES:
            flown = ", ".join(simplified_autopilot.MODE_NAMES)
            return f"mode {text} is not supported by the simplified autopilot; there are: {flown}"
        self._enter(vehicle, simplified_autopilot.MODE_NAMES.index(text))
        return ""

    def _arm(self, vehicle: np.record) -> str:
        if vehicle.armed:
            return ""
        if vehicle.mode in simplified_autopilot.NO_ARMING:
            return f"arming denied in mode {simplified_autopilot.MODE_NAMES[vehicle.mode]}"
        simplified_autopilot.arm(vehicle)
        return ""

    def _enter(self, vehicle: np.record, mode: int) -> None:
        simplified_autopilot.enter(vehicle, mode)
        vehicle.hovering = 0  # the mode moves the vehicle: a later HOVER must capture a new position
        if mode in (simplified_autopilot.LOITER, simplified_autopilot.POSCTL):
            simplified_autopilot.brake(vehicle, self._record[0])
        if mode == simplified_autopilot.OFFBOARD and vehicle.kind == HOLD:
            vehicle.setpoint[:] = vehicle.position

    # setpoints

    def steer(self, kind: int, vectors: Array, given: Mask) -> None:
        """Set the setpoints of some vehicles; see ``Vehicles``. HOLD captures the current positions.

        Raises:
            ValueError: unknown kind, wrong shape, or a vector that is not finite; the message names its vehicle.
        """
        if kind not in _KINDS:
            raise ValueError(f"kind of setpoint: {kind!r} is not allowed, one of {_KINDS}")
        if vectors.shape != self.position.shape or given.shape != self.yaw.shape:
            raise ValueError(
                f"setpoints: shapes {vectors.shape} and {given.shape} are not allowed, "
                f"{self.position.shape} and {self.yaw.shape}"
            )
        bad = set_many(self._vehicles, kind, vectors, given, self._dead_zone, HOVER_YAW_RATE)
        if bad >= 0:
            raise ValueError(f"setpoint of {self.names[bad]}: {vectors[bad].tolist()}, finite numbers are needed")

    def steer_one(
        self,
        index: int,
        kind: int,
        vector: tuple[float, float, float],
        yaw_rate: float = 0.0,
        *,
        yaw: float = math.nan,
    ) -> None:
        """Set one vehicle's setpoint, ENU, with a yaw rate, rad/s, or a heading, rad, if given.

        Raises:
            IndexError: ``index`` is out of range.
            ValueError: unknown kind, or a value that is not finite.
        """
        if not 0 <= index < len(self.names):
            raise IndexError(f"vehicle {index} does not exist; 0 to {len(self.names) - 1}")
        if kind not in _KINDS:
            raise ValueError(f"kind of setpoint: {kind!r} is not allowed, one of {_KINDS}")
        x, y, z = (float(value) for value in vector)
        if not all(map(math.isfinite, (x, y, z, yaw_rate))) or math.isinf(yaw):
            raise ValueError(
                f"setpoint of {self.names[index]}: {(x, y, z)}, yaw rate {yaw_rate}: finite numbers are needed"
            )
        set_at(self._vehicles, index, kind, x, y, z, float(yaw), float(yaw_rate), self._dead_zone, HOVER_YAW_RATE)

    # time

    def advance(self, time_us: int) -> None:
        """Advance to ``time_us``, a multiple of ``step_us``; stops on the way do not affect the motion.

        Raises:
            ValueError: ``time_us`` is not such a multiple, or lies in the past.
        """
        steps, rest = divmod(time_us - self.time_us, self.step_us)
        if rest or steps < 0:
            raise ValueError(
                f"time: {time_us} us is not allowed, a multiple of {self.step_us} us from {self.time_us} us on"
            )
        changed = advance(
            self._vehicles,
            self._record,
            self._delayed,
            self.time_us // self.step_us,
            steps,
            self.step_us * 1e-6,
            self.position,
            self.velocity,
            self.yaw,
        )
        self.time_us = time_us
        if changed:
            self._look()

    def close(self) -> None:
        """Do nothing: no resources are held."""


def spawn_places(count: int) -> Array:
    """Return the spawn grid, shape (count, 3), m ENU, filled along x first; as upstream, the first row is at y = 3."""
    columns = origin_columns(count)
    index = np.arange(count)
    return np.column_stack([PITCH * (index % columns), PITCH * (index // columns + 1), np.zeros(count)])


def check_places(places: ArrayLike, count: int) -> Array:
    """Return ``places`` as an array of shape (count, 3).

    Raises:
        ValueError: wrong shape, a value that is not finite, or a position below the ground.
    """
    array = np.array(places, dtype=float)
    if array.shape != (count, 3):
        shape = " x ".join(map(str, array.shape))
        raise ValueError(f"places: {shape} numbers are not allowed; {count} x 3, m ENU")
    bad = ~np.isfinite(array).all(axis=1) | (array[:, 2] < 0.0)
    if bad.any():
        worst = int(np.argmax(bad))
        raise ValueError(f"places: {array[worst].tolist()} of vehicle {worst} is not allowed, finite with z >= 0")
    return array


def check_headings(headings: ArrayLike, count: int) -> Array:
    """Return ``headings`` in -pi..pi as an array of shape (count,).

    Raises:
        ValueError: wrong shape, or a value that is not finite.
    """
    array = np.array(headings, dtype=float)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise ValueError(f"headings: {headings!r} is not allowed, {count} finite numbers, rad")
    return np.array([wrap_pi(yaw) for yaw in array.tolist()])
