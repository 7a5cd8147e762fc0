"""Turns of a node that run in compiled code as long as nothing unusual happens.

``lockstep_io.Turns`` has the inner loop: wait for TICK, read the due messages of certain topics, call the node's
program, send the messages that it publishes, and send DONE. Python runs every turn in which anything else arrives or
which the program declines; its objects are then in the same state as if it had run all turns itself. A compiled turn
touches a few kilobytes of memory, whereas the interpreter's working set, separate for each process of a fleet, does not
stay in the CPU caches from turn to turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from xtdrone_native import lockstep_io

from ..protocol import DIGEST_PERIOD_US, Barrier
from ..transport.inbox import Inbox
from ..transport.outlets import Outlet
from ..transport.publisher import CountingPublisher
from .messages_due import Deliveries
from .node_state import Node
from .server_link import ServerConnection
from .topics import Publisher

_FAR_US = 1 << 62  # us; the turns have no end
_LONGEST_WAIT = 1.0  # s of wall time

_Inputs = list[tuple[int, int, Inbox]]
"""Topic, channel and inbox."""
_Outputs = list[tuple[CountingPublisher, list[Outlet]]]
"""Publishing end and its connections."""


class CompiledWork(Protocol):
    """The work of a node's turn as a compiled program (``xtdrone_lockstep/turn_program.h``).

    Attributes:
        received: Resolved names of the topics that the program receives, in its order. On a latched topic it accepts
            only repetitions of the last message.
        published: The publishers of the topics that it publishes, in its order.
    """

    received: Sequence[str]
    published: Sequence[Publisher]

    def begin(self) -> Any:
        """Return the program's capsule with the current state; None if Python must take the next turn."""

    def end(self) -> None:
        """Bring the Python objects up to date with the program."""


class CompiledTurns:
    """Runs turns of a participant by a compiled program."""

    def __init__(self, node: Node, connection: ServerConnection, deliveries: Deliveries, work: CompiledWork) -> None:
        """Store the arguments; ``carry`` runs the turns.

        Args:
            node: The participant's node.
            connection: Its connection to the simulator.
            deliveries: The connections to its subscribers.
            work: The work of its turns.
        """
        self._node = node
        self._connection = connection
        self._deliveries = deliveries
        self._work = work
        self._turns: lockstep_io.Turns | None = None

    def stop(self) -> tuple[int, int] | None:
        """Leave the next turn to Python; may be called in any thread.

        Returns:
            Number and time in microseconds of the last compiled turn; None if no compiled turns are running.
        """
        turns = self._turns
        if turns is None:
            return None
        turns.stop()
        return turns.tick, turns.time_us

    def carry(self, tick: int, time_us: int) -> tuple[Barrier | None, int, int]:
        """Run compiled turns for as long as possible.

        Args:
            tick: Number of the last turn.
            time_us: Its simulation time in microseconds.

        Returns:
            The TICK of Python's next turn, None if it has not arrived yet; number and time of the last turn run.

        Raises:
            OSError: The connection to the simulator is broken.
            ProtocolError: Its data is invalid.
        """
        program = self._work.begin()
        if program is None or not self._nothing_waits():
            return None, tick, time_us
        node, work = self._node, self._work
        # From here on a new or closed connection stops the turns, so that they neither miss nor outlive one.
        turns = self._turns = self._connection.compiled_turns(node.reader, len(work.received), tick, time_us)
        inputs, outputs = self._inputs(), self._outputs()
        if inputs is None or outputs is None:
            self._turns = None
            return None, tick, time_us
        self._connect(turns, inputs, outputs)
        until_us = _FAR_US if node.digests is None else (time_us // DIGEST_PERIOD_US + 1) * DIGEST_PERIOD_US
        try:
            found = self._connection.carry(node.reader, turns, program, until_us, _LONGEST_WAIT)
        finally:
            self._turns = None
            self._take_back(turns, inputs, outputs)
            work.end()
        return found, turns.tick, turns.time_us

    def _nothing_waits(self) -> bool:
        """Return whether no message is to be dispatched in the next turn whatever its TICK says."""
        return not any(
            entry.pending or any(inbox.target is None and inbox.messages for inbox in inboxes)
            for entry, inboxes in self._node.connected_subscribers()
        )

    def _inputs(self) -> _Inputs | None:
        """Return the connections to the program's topics; None if compiled code cannot read one."""
        inputs: _Inputs = []
        for topic, name in enumerate(self._work.received):
            channels = self._deliveries.channels_of(name)
            if len(channels) > 1 or (channels and self._node.ends[name].statistics_logger):
                return None
            inputs += [(topic, channel, inbox) for channel, inbox in channels]
        plain = all(
            inbox.feed is not None and not (inbox.closed or inbox.lost or inbox.given_up or inbox.dropped)
            for _, _, inbox in inputs
        )
        return inputs if plain else None

    def _outputs(self) -> _Outputs | None:
        """Return the program's publishing ends; None if one needs Python, or Python's first message with digests."""
        digests = self._node.digests
        outputs: _Outputs = []
        for publisher in self._work.published:
            end = publisher.impl
            outlets = None if end is None else end.compiled_outlets()
            if outlets is None or (digests is not None and publisher.resolved_name not in digests):
                return None
            outputs.append((end, outlets))
        return outputs

    def _connect(self, turns: lockstep_io.Turns, inputs: _Inputs, outputs: _Outputs) -> None:
        for topic, channel, inbox in inputs:
            if inbox.feed is not None:
                turns.add_input(topic, channel, inbox.feed.sock, inbox.feed.lend(), inbox.taken)
        digests = self._node.digests
        for topic, (end, outlets) in enumerate(outputs):
            turns.add_output(end.seq, None if digests is None else digests[end.resolved_name].add)
            for outlet in outlets:
                sock = outlet.sock
                if sock is None:  # closed since
                    turns.stop()
                else:
                    turns.add_connection(topic, outlet.number, outlet.count, sock)

    @staticmethod
    def _take_back(turns: lockstep_io.Turns, inputs: _Inputs, outputs: _Outputs) -> None:
        for (_, _, inbox), (_, taken, size) in zip(inputs, turns.inputs, strict=True):
            if inbox.feed is not None:
                inbox.feed.take_back(taken, size)
        sent = {number: (total, rest, failure) for number, total, rest, failure in turns.connections}
        for (end, outlets), (count, size) in zip(outputs, turns.outputs, strict=True):
            end.record(count, size)
            for outlet in outlets:
                if outlet.number in sent:
                    total, rest, failure = sent[outlet.number]
                    outlet.record(total, size, rest, failure)
