"""A stock follower's turns in compiled code, including its vehicle's commands if the same process carries them out.

The program ``follower_turn`` computes what :class:`~xtdrone_coordination.follower.Follower` and
``MultirotorCommunication`` do while nothing changes but positions and velocity commands, bit-identical to them. A
follower that overrides a method of the turn runs in Python.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from xtdrone_native.follower_turn import FollowerTurn, Settings

from xtdrone_coordination.follower import Follower
from xtdrone_coordination.known_swarm_state import SwarmState

if TYPE_CHECKING:
    import xtdrone_lockstep as lockstep
    from xtdrone_control.communication.multirotor import MultirotorCommunication

_METHODS = (
    "update",
    "law_output",
    "evaluate_law",
    "control_law",
    "neighbours",
    "avoidance",
    "checked_vector",
    "report_missing",
    "_known_peers",
    "_limit",
    "_own_avoidance",
    "_near",
)
_ATTRIBUTES = ("id", "count", "offsets", "weights", "options", "swarm", "avoidance_vector", "problem_log")


def is_stock(follower: Follower) -> bool:
    """Return whether neither the follower's class nor the object itself overrides a method of the turn."""
    methods = all(getattr(getattr(follower, name), "__func__", None) is getattr(Follower, name) for name in _METHODS)
    attributes = any(hasattr(type(follower), name) for name in _ATTRIBUTES)
    return methods and not attributes and type(follower.swarm) is SwarmState


class CompiledFollower:
    """The compiled turn of one follower; a ``CompiledWork`` of the lockstep.

    Attributes:
        received: resolved names of the topics that the program receives, in its order.
        published: publishers of what it publishes, in its order.
    """

    def __init__(
        self,
        follower: Follower,
        received: Sequence[str],
        published: Sequence[lockstep.Publisher],
        repeated: Callable[[], tuple[Sequence[float], Sequence[int]]],
        communication: MultirotorCommunication | None,
    ) -> None:
        """Store the arguments; :meth:`begin` creates the program.

        Args:
            follower: one that :func:`is_stock`.
            received: resolved names of the topics of pattern, topology, states of all vehicles, mavros/state, own pose
                and velocity command.
            published: publishers of the setpoint (with ``communication``), the velocity command, and the avoidance
                (unless it is off).
            repeated: returns the numbers of the last messages of pattern and topology.
            communication: carries out the vehicle's commands in this process; None if another node does.
        """
        self.received = received
        self.published = published
        self._follower = follower
        self._repeated = repeated
        self._communication = communication
        self._program: FollowerTurn | None = None

    def begin(self) -> Any:
        """Return the program's capsule with the current state; None if Python must take the next turn."""
        follower, options = self._follower, self._follower.options
        offsets = follower.offsets
        if offsets is None or options.mode != "vel" or options.avoid == "topic" or not is_stock(follower):
            return None
        steady = None if self._communication is None else self._communication.steady()
        if self._communication is not None and steady is None:
            return None
        settings = Settings(
            options.Kp,
            not options.raw_weights,
            options.limit,
            options.avoid == "own",
            options.Kp_avoid,
            options.avoid_radius,
            options.clearance,
        )
        self._program = program = FollowerTurn(follower.id, settings, offsets, list(follower.weights.items()))
        pattern, topology = self._repeated()
        if all(map(math.isfinite, pattern)):  # others are rejected again in each repetition
            program.ignore(struct.pack(f"<{len(pattern)}f", *pattern), struct.pack(f"<{len(topology)}i", *topology))
        if steady is not None:
            state, packet = steady
            since = math.nan if state.moving_since is None else state.moving_since
            program.carry_out(
                state.hover_speed, state.cmd_timeout, state.hovering, since, packet, state.mode, state.armed
            )
        return program.program()

    def end(self) -> None:
        """Bring follower and communication up to date with the turns that the program has taken."""
        program = self._program
        if program is None or not program.turns:
            return
        follower = self._follower
        follower.swarm.ticks += program.turns - 1
        follower.swarm.hear_states(program.states)
        follower.swarm.tick()
        x, y, z = program.avoidance
        follower.avoidance_vector = (x, y, z)
        for _ in range(min(program.turns, 2)):  # without problems
            follower.problem_log.begin_update()
        if self._communication is not None:
            self._communication.catch_up(program.pose, program.command)
