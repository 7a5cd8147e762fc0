"""What the simulator's node runs: the cut between time, lockstep and control, and the world with its door."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Protocol

from gazebo_msgs.msg import ModelStates

from xtdrone_control.lockstep.server import LockstepServer
from xtdrone_sim.runtime.mailbox import Mailbox

Idle = Callable[[float], None]
"""Waits up to so many wall seconds and serves everything but the lockstep's server meanwhile."""


class Scene(Protocol):
    """A world with its vehicles, and the door through which other nodes reach these: MAVLink, say, or topics.

    All is called in the simulator's own thread.

    Attributes:
        names: the vehicles', in order of their numbers.
        scenery: of what else is in the world, in the order of their numbers, which go on from the vehicles'.
        actors: which of those walk.
        step_us: the base step, microseconds.
    """

    names: Sequence[str]
    scenery: Sequence[str]
    actors: Sequence[str]
    step_us: int

    @property
    def time_us(self) -> int:
        """Simulated time, microseconds."""

    @property
    def gravity(self) -> float:
        """In m/s^2."""

    @property
    def need_time(self) -> bool:
        """Whether whoever is asked through the door may answer only when time goes on."""

    @property
    def descriptors(self) -> Sequence[int]:
        """File descriptors on which something may come through the door; see ``serve``."""

    @property
    def patience(self) -> float:
        """The longest wait for something to come, wall s."""

    def open(self, server: LockstepServer, mailbox: Mailbox, idle: Idle) -> None:
        """Open the door: the node's services stand, time does not flow yet.

        Args:
            server: the lockstep's.
            mailbox: brings requests from other threads to the simulator's.
            idle: see ``Idle``; it calls ``serve``.
        """

    def missing(self) -> str:
        """Say for whom time should not begin yet; "" for nobody."""

    def serve(self, ready: Collection[int]) -> None:
        """Act on what has come on those of ``descriptors`` that are ready; returns at once."""

    def next_due_us(self, now_us: int) -> int | None:
        """Return the next time at which the scene itself is to be looked at, or None."""

    def next_told_us(self, now_us: int) -> int | None:
        """Return the next time at which ``tick`` tells something to those who listen, or None while nobody does."""

    def advance(self, until_us: int) -> None:
        """Step to ``until_us``, or beyond by less than a step."""

    def step(self) -> None:
        """Advance by one step in the middle of a tick."""

    def tick(self, idle: Idle) -> None:
        """Send what is to be seen now, run one barrier of the server given to ``open``, take what came by it."""

    def truth(self) -> bytes:
        """Return the vehicles' true states, for the digests."""

    def model_states(self) -> ModelStates:
        """Return them as Gazebo has them."""

    def collisions(self) -> set[tuple[int, int]]:
        """Return who has hit whom or what so far, by their numbers."""

    def restart(self, time_us: int) -> None:
        """Put all back to its start, with simulated time going on from ``time_us``."""

    def close(self) -> None:
        """Free what is held."""
