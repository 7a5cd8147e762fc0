"""Classes through which a script commands one vehicle or several at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .verbs import Steps, Verbs, check_numbers, check_positive


class Runner(Protocol):
    """Carries out verbs."""

    def run(self, verb: str, steps: dict[str, Steps]) -> None:
        """Run a verb for several vehicles at once until it has ended for each."""

    def watch(self) -> None:
        """Pass statuses of /diagnostics to the vehicles from now on."""

    def release(self, names: Sequence[str]) -> None:
        """Stop commanding vehicles; those in OFFBOARD hold position from now on."""


class _Flyer:
    """Base class of one vehicle and of several: the verbs that need no data of a single vehicle."""

    def __init__(self, runner: Runner, vehicles: Sequence[Verbs]) -> None:
        self._runner = runner
        self._vehicles = vehicles

    def _run(self, verb: str, start: Callable[[int, Verbs], Steps]) -> None:
        self._runner.run(verb, {v.name: start(i, v) for i, v in enumerate(self._vehicles)})

    def arm(self, timeout: float = 30.0) -> None:
        """Arm as soon as the autopilot reports that it is ready, after ``timeout`` s at the latest."""
        check_positive("arm", timeout=timeout)
        self._run("arm", lambda _, v: v.arm(timeout))

    def disarm(self) -> None:
        """Disarm on the ground."""
        self._run("disarm", lambda _, v: v.disarm())

    def takeoff(self, height: float, *, tolerance: float = 0.3, timeout: float | None = None) -> None:
        """Climb straight up in OFFBOARD.

        Args:
            height: m above the current position, more than 0.
            tolerance: m of height within which the verb is done.
            timeout: s; None: 20 s and 2 s a metre.
        """
        check_positive("takeoff", height=height, tolerance=tolerance, timeout=timeout)
        self._run("takeoff", lambda _, v: v.takeoff(height, tolerance, timeout))

    def hold(self) -> None:
        """Stop, and hold position in OFFBOARD."""
        self._run("hold", lambda _, v: v.hold())

    def brake(self) -> None:
        """Stop as quickly as the autopilot can, with velocity zero in OFFBOARD.

        Unlike ``hold`` it needs no position, and works while a watched component reports an error.
        """
        self._run("brake", lambda _, v: v.brake())

    def watch(self, *components: str, patience: float = 0.0) -> None:
        """Raise ``FaultError`` from verbs that fly when a component reports an error on /diagnostics.

        ``arm`` waits until there is no error. ``brake`` and ``land`` are not affected.

        Args:
            components: names without the vehicle's, such as ``lidar_odometry``.
            patience: s for which the error must have lasted.
        """
        check_numbers("watch", patience=patience)
        for vehicle in self._vehicles:
            vehicle.watch(components, patience)
        self._runner.watch()

    def land(self, timeout: float = 120.0) -> None:
        """Land, and wait until the autopilot has disarmed; do nothing if it is already disarmed."""
        check_positive("land", timeout=timeout)
        self._run("land", lambda _, v: v.land(timeout))

    def set_mode(self, mode: str) -> None:
        """Switch to a flight mode, given by its name in MAVROS, such as ``AUTO.RTL``."""
        self._run("set_mode", lambda _, v: v.set_mode(mode))

    def wait(self, seconds: float) -> None:
        """Wait in ROS time while setpoints are streamed."""
        check_positive("wait", seconds=seconds)
        self._run("wait", lambda _, v: v.wait(seconds))

    def close(self) -> None:
        """Stop commanding; a vehicle in OFFBOARD is switched to AUTO.LOITER and holds position."""
        self._runner.release([v.name for v in self._vehicles])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Drone(_Flyer):
    """One vehicle. See ``xtdrone_control.drone`` for frames, units, time and errors."""

    def __init__(self, runner: Runner, verbs: Verbs) -> None:
        """Command the vehicle of ``verbs``; ``connect`` creates the object."""
        super().__init__(runner, [verbs])
        self._verbs = verbs

    @property
    def name(self) -> str:
        """Name, such as ``iris_0``."""
        return self._verbs.name

    @property
    def position(self) -> NDArray[np.float64]:
        """(3,) m ENU; NaN while unknown."""
        pose = self._verbs.core.pose
        return np.full(3, math.nan) if pose is None else np.array(pose[0])

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(3,) m/s ENU; NaN while unknown."""
        velocity = self._verbs.telemetry.velocity
        return np.full(3, math.nan) if velocity is None else np.array(velocity)

    @property
    def heading(self) -> float:
        """Heading, rad ENU in (-pi, pi]; NaN while unknown."""
        pose = self._verbs.core.pose
        return math.nan if pose is None else pose[1]

    @property
    def battery(self) -> float:
        """Remaining charge, 0..1; NaN while unknown."""
        return self._verbs.telemetry.battery

    @property
    def mode(self) -> str:
        """Flight mode by its name in MAVROS, such as ``OFFBOARD``."""
        return self._verbs.core.mode

    @property
    def armed(self) -> bool:
        """Whether the motors are armed."""
        return self._verbs.core.armed

    def go_to(
        self,
        x: float,
        y: float,
        z: float,
        heading: float | None = None,
        *,
        tolerance: float = 0.3,
        timeout: float | None = None,
    ) -> None:
        """Fly to a position in OFFBOARD, and stay there.

        Args:
            x, y, z: m ENU.
            heading: rad ENU; None keeps the current one.
            tolerance: m from the goal within which the verb is done.
            timeout: s; None: 20 s and 2 s a metre.
        """
        check_numbers("go_to", x=x, y=y, z=z, heading=heading or 0.0)
        check_positive("go_to", tolerance=tolerance, timeout=timeout)
        self._run("go_to", lambda _, v: v.go_to((x, y, z), heading, tolerance, timeout))

    def set_velocity(self, vx: float, vy: float, vz: float, yaw_rate: float = 0.0, *, body: bool = False) -> None:
        """Fly at a velocity in OFFBOARD until the next verb that moves the vehicle; return at once.

        Args:
            vx, vy, vz: m/s ENU, or FLU if ``body``; all zero holds the position.
            yaw_rate: rad/s, counter-clockwise.
            body: whether the velocity is along the vehicle's own axes: forward, left, up.
        """
        check_numbers("set_velocity", vx=vx, vy=vy, vz=vz, yaw_rate=yaw_rate)
        self._run("set_velocity", lambda _, v: v.set_velocity((vx, vy, vz), yaw_rate, body=body))

    def __repr__(self) -> str:
        x, y, z = self.position
        state = "armed" if self.armed else "disarmed"
        return f"<{self.name}: {self.mode}, {state}, at ({x:.2f}, {y:.2f}, {z:.2f}) m>"


class DroneGroup(_Flyer):
    """Several vehicles: each verb acts on all of them at once, and returns when it is done for all.

    If a verb fails for some vehicles, the others still carry it out; then the error is raised.
    """

    def __init__(self, drones: Sequence[Drone]) -> None:
        """Command ``drones``, at least one; ``connect_all`` creates the object."""
        super().__init__(drones[0]._runner, [drone._verbs for drone in drones])
        self.drones = list(drones)

    def __len__(self) -> int:
        return len(self.drones)

    def __iter__(self) -> Iterator[Drone]:
        return iter(self.drones)

    def __getitem__(self, index: int) -> Drone:
        return self.drones[index]

    @property
    def names(self) -> list[str]:
        """N names, such as ``iris_0``."""
        return [drone.name for drone in self.drones]

    @property
    def position(self) -> NDArray[np.float64]:
        """(N, 3) m ENU; NaN while unknown."""
        return np.array([drone.position for drone in self.drones])

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(N, 3) m/s ENU; NaN while unknown."""
        return np.array([drone.velocity for drone in self.drones])

    @property
    def heading(self) -> NDArray[np.float64]:
        """(N,) rad ENU in (-pi, pi]; NaN while unknown."""
        return np.array([drone.heading for drone in self.drones])

    @property
    def battery(self) -> NDArray[np.float64]:
        """(N,) remaining charge, 0..1; NaN while unknown."""
        return np.array([drone.battery for drone in self.drones])

    @property
    def mode(self) -> list[str]:
        """N flight modes by their names in MAVROS."""
        return [drone.mode for drone in self.drones]

    @property
    def armed(self) -> NDArray[np.bool_]:
        """(N,) whether the motors are armed."""
        return np.array([drone.armed for drone in self.drones])

    def go_to(
        self,
        positions: ArrayLike,
        headings: ArrayLike | None = None,
        *,
        tolerance: float = 0.3,
        timeout: float | None = None,
    ) -> None:
        """Fly to positions in OFFBOARD, and stay there.

        Args:
            positions: (N, 3) m ENU, one for each vehicle.
            headings: (N,) or one for all, rad ENU; None keeps the current ones.
            tolerance: m from the goal within which the verb is done.
            timeout: s; None: 20 s and 2 s a metre.
        """
        goals = self._rows("go_to", "positions", positions, broadcast=False)
        turns = None if headings is None else self._numbers("go_to", "headings", headings)
        check_positive("go_to", tolerance=tolerance, timeout=timeout)
        self._run("go_to", lambda i, v: v.go_to(goals[i], None if turns is None else turns[i], tolerance, timeout))

    def set_velocity(self, velocities: ArrayLike, yaw_rates: ArrayLike = 0.0, *, body: bool = False) -> None:
        """Fly at velocities in OFFBOARD until the next verb that moves the vehicles; return at once.

        Args:
            velocities: (N, 3), or (3,) for all, m/s ENU, or FLU if ``body``; all zero holds the position.
            yaw_rates: (N,) or one for all, rad/s, counter-clockwise.
            body: whether the velocities are along each vehicle's own axes: forward, left, up.
        """
        rows = self._rows("set_velocity", "velocities", velocities, broadcast=True)
        rates = self._numbers("set_velocity", "yaw_rates", yaw_rates)
        self._run("set_velocity", lambda i, v: v.set_velocity(rows[i], rates[i], body=body))

    def _rows(self, verb: str, name: str, values: ArrayLike, *, broadcast: bool) -> list[tuple[float, float, float]]:
        array, count = np.asarray(values, float), len(self.drones)
        if array.shape != (count, 3) and not (broadcast and array.shape == (3,)):
            shapes = f"({count}, 3) or (3,)" if broadcast else f"({count}, 3)"
            raise ValueError(f"{verb}: {name} of shape {array.shape} is not allowed, {shapes}")
        check_numbers(verb, **{f"{name}[{i}]": value for i, value in enumerate(array.ravel().tolist())})
        return [(x, y, z) for x, y, z in np.broadcast_to(array, (count, 3)).tolist()]

    def _numbers(self, verb: str, name: str, values: ArrayLike) -> list[float]:
        array, count = np.asarray(values, float), len(self.drones)
        if array.shape not in ((), (count,)):
            raise ValueError(f"{verb}: {name} of shape {array.shape} is not allowed, ({count},) or one number")
        check_numbers(verb, **{f"{name}[{i}]": value for i, value in enumerate(array.ravel().tolist())})
        return [float(value) for value in np.broadcast_to(array, (count,))]
