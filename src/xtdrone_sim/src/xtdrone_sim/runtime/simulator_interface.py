"""Interface between the simulator node (time, lockstep, control) and the simulated world that it runs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Protocol

from gazebo_msgs.msg import ModelStates

from xtdrone_common.fleet import StartPose
from xtdrone_common.rotation import Vector
from xtdrone_lockstep.server import LockstepServer
from xtdrone_sim.mailbox import Mailbox

Idle = Callable[[float], None]
"""Waits up to the given wall time, s, and meanwhile serves everything except the lockstep server."""
HEAD_START = 0.005
"""Wall time, s, in which participants may end their turns before the simulator serves other sockets again."""


class SimulatorBackend(Protocol):
    """A world with vehicles and the interface through which other nodes reach them, e.g. MAVLink or topics.

    All methods are called in the simulator's own thread.

    Attributes:
        names: names of the vehicles, in order of their indices.
        actors: names of the moving actors.
        step_us: base step, microseconds.
        overlap: the world advances to the next tick while participants work on the current one. Their messages then
            take effect at the next tick; without overlap, at once.
    """

    names: Sequence[str]
    actors: Sequence[str]
    step_us: int
    overlap: bool

    @property
    def time_us(self) -> int:
        """Simulated time, microseconds."""

    @property
    def gravity(self) -> float:
        """Gravity, m/s^2."""

    @property
    def need_time(self) -> bool:
        """Whether the vehicles can answer requests only while simulated time advances."""

    @property
    def descriptors(self) -> Sequence[int]:
        """File descriptors on which requests may arrive; see ``serve``."""

    @property
    def patience(self) -> float:
        """Longest wait for ``descriptors`` before ``serve`` must be called, wall s."""

    def open(self, server: LockstepServer, mailbox: Mailbox, idle: Idle) -> None:
        """Open the interface to other nodes; the services of the node exist and time has not started.

        Args:
            server: lockstep server.
            mailbox: passes requests from other threads to the simulator's thread.
            idle: see ``Idle``; it calls ``serve``.
        """

    def missing(self) -> str:
        """Return a text on the missing autopilots, without which time must not start; "" when all are present."""

    def serve(self, ready: Collection[int]) -> None:
        """Process the data that has arrived on the ready ones of ``descriptors``, without blocking."""

    def next_due_us(self, now_us: int) -> int | None:
        """Return the next time at which the back end itself needs a tick, or None."""

    def next_publication_us(self, now_us: int) -> int | None:
        """Return the next time at which ``tick`` publishes to a subscriber, or None without subscribers."""

    def advance(self, until_us: int) -> None:
        """Step to ``until_us``, or beyond by less than a step."""

    def step(self) -> None:
        """Advance by one step in the middle of a tick."""

    def begin_tick(self, idle: Idle) -> None:
        """Publish the current data, and begin a barrier of the lockstep server."""

    def end_tick(self, idle: Idle) -> None:
        """Wait for the end of the barrier, and process the delivered messages; nothing is served before."""

    def truth(self) -> bytes:
        """Return the true states of the vehicles, as bytes for the digests."""

    def model_states(self) -> ModelStates:
        """Return the poses and velocities of all models in Gazebo's format."""

    def collisions(self) -> set[tuple[str, str]]:
        """Return all collisions so far, as pairs of names."""

    def restart(self, time_us: int) -> None:
        """Restore the initial state; simulated time continues from ``time_us``, microseconds."""

    def reset_vehicle(self, name: str, pose: StartPose | None) -> None:
        """Reset one vehicle, disarmed, as after a reboot; the others are not affected.

        Args:
            name: name of the vehicle, such as ``iris_3``.
            pose: its new pose; None: its start pose.

        Raises:
            ValueError: there is no such vehicle, or its place is not free; nothing has changed then.
        """

    def add_vehicle(self, name: str, model: str, pose: StartPose | None) -> None:
        """Add a vehicle in flight; see ``Simulation.add_vehicle``.

        Raises:
            ValueError: it cannot join; nothing has changed then.
            OSError: one of its ports is in use; nothing has changed then.
        """

    def remove_vehicle(self, name: str) -> None:
        """Remove a vehicle from the simulation.

        Raises:
            ValueError: there is no such vehicle, or it cannot leave.
        """

    def set_wind(self, velocity: Vector) -> None:
        """Set the world's wind, m/s, ENU, until the next restart.

        Raises:
            ValueError: the value is not allowed, or there is no wind; nothing has changed then.
        """

    def close(self) -> None:
        """Release all resources."""


def index_of(name: str, names: Sequence[str]) -> int:
    """Return the index of a vehicle.

    Raises:
        ValueError: no vehicle has this name; the message lists the names.
    """
    if name not in names:
        raise ValueError(f"name: {name[:80]!r} is not in the simulation; there are {', '.join(names)}")
    return list(names).index(name)
