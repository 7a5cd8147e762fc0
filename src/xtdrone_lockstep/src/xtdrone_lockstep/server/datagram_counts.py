"""The server's counts of UDP datagrams in both directions between the simulator and participants."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping

from ..protocol import ProtocolError
from .participant import Participant


class DatagramCounts:
    """Cumulative numbers of datagrams by UDP port.

    Attributes:
        sent: Datagrams sent by the simulator until the last tick, by the participants' port.
        expected: Datagrams that participants report having sent, by the simulator's port.
    """

    def __init__(self) -> None:
        self.sent: dict[int, int] = {}
        self.expected: dict[int, int] = {}
        self._ports: frozenset[int] = frozenset()
        self._sent_so_far: Callable[[], Mapping[int, int]] = lambda: self.sent
        self._remote_ports: set[int] = set()

    def open_ports(self, ports: Collection[int], sent_so_far: Callable[[], Mapping[int, int]] | None = None) -> None:
        """Set the UDP ports on which the simulator receives datagrams; counts of all other ports are ignored.

        Args:
            ports: The ports.
            sent_so_far: Returns the numbers of datagrams sent until now, by the participants' port; by default those
                at the last tick count.
        """
        self._ports = frozenset(ports)
        if sent_so_far is not None:
            self._sent_so_far = sent_so_far

    def take(self, sent: Mapping[int, int], participants: Iterable[Participant]) -> None:
        """Store the numbers of datagrams sent to the participants' ports; ``sent`` may have thousands of others."""
        ports = (port for participant in participants for port in participant.udp_ports)
        self.sent = {port: sent[port] for port in ports if port in sent}

    def add_participant(self, participant: Participant, udp_ports: tuple[int, ...]) -> None:
        """Start counting for a participant that joins.

        Args:
            participant: The participant.
            udp_ports: Local ports on which it receives; ignored unless the simulator has opened ports.
        """
        participant.udp_ports = udp_ports if self._ports else ()
        # Datagrams sent before it joined need not have reached it: it may have bound its port just now.
        sent = self._sent_so_far() if participant.udp_ports else {}
        participant.datagrams_base = {port: sent.get(port, 0) for port in participant.udp_ports}

    def news_for(self, participant: Participant) -> dict[int, int]:
        """Return the counts of a participant's ports that changed since its last TICK."""
        news = {}
        for port in participant.udp_ports:
            reported = participant.datagrams_reported.get(port, 0)
            # The simulator may have discarded the count of a port that it no longer uses.
            count = max(reported, self.sent.get(port, 0) - participant.datagrams_base.get(port, 0))
            if count != reported:
                participant.datagrams_reported[port] = count
                news[port] = count
        return news

    def count(self, participant: Participant, counts: Mapping[int, int]) -> None:
        """Add the datagrams that a participant reports.

        Args:
            participant: The sender.
            counts: Cumulative numbers by the simulator's port.

        Raises:
            ProtocolError: A count has decreased.
        """
        for port, count in counts.items():
            if port not in self._ports:
                continue
            before = participant.datagrams_sent.get(port, 0)
            if count < before:
                raise ProtocolError(f"DONE: {count} datagrams to port {port}, after {before} before")
            participant.datagrams_sent[port] = count
            (self._remote_ports.add if participant.remote else self._remote_ports.discard)(port)
            self.expected[port] = self.expected.get(port, 0) + count - before

    def is_sender_remote(self, port: int) -> bool:
        """Return whether the last participant to send to one of the simulator's ports runs on another machine."""
        return port in self._remote_ports
