"""The MAVLink door of all vehicles: two UDP links each, as upstream XTDrone's PX4 instances have them."""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import TYPE_CHECKING

from xtdrone_control.autopilot.commander import Commander
from xtdrone_control.fleet import GCS_REMOTE_PORT, Vehicle

from .link import LOOPBACK, Link
from .receiver import Receiver
from .streams import GCS_RATES, ONBOARD_RATES
from .telemetry import Telemetry

if TYPE_CHECKING:
    from xtdrone_control.autopilot.autopilot import Autopilot

_MAX_DATAGRAMS = 256  # read from one link before the others have their turn
_MAX_ROUNDS = 16  # of that; 4096 small datagrams are more than a socket's buffer holds, and a flood must not hold us
_LOOK_PERIOD = 0.1  # s of wall time between two looks at whether ground stations hear enough


class _Vehicle:
    """One vehicle's links, and what serves them."""

    def __init__(self, vehicle: Vehicle, autopilot: Autopilot, commander: Commander, index: int, host: str) -> None:
        self.index = index
        self.commander = commander
        self.receiver = Receiver(commander, autopilot, index)
        telemetry = Telemetry(commander, autopilot, index)
        ends = (
            ("offboard", vehicle.offboard_local_port, vehicle.offboard_remote_port, ONBOARD_RATES, False),
            ("ground-station", vehicle.gcs_local_port, GCS_REMOTE_PORT, GCS_RATES, True),
        )
        self.links: list[Link] = []
        try:
            for kind, local, remote, rates, by_wall in ends:
                self.links.append(Link(vehicle, kind, local, remote, telemetry, rates, host, by_wall=by_wall))
        except OSError:
            self.close()
            raise

    def reboot(self, autopilot: Autopilot, commander: Commander) -> None:
        self.commander = commander
        self.receiver = Receiver(commander, autopilot, self.index)
        telemetry = Telemetry(commander, autopilot, self.index)
        for link in self.links:
            link.reboot(telemetry, autopilot.time_us)

    def close(self) -> None:
        for link in self.links:
            link.close()


class MavlinkServer:
    """MAVLink of a fleet. One thread calls everything; nothing here blocks but ``receive`` with a timeout."""

    def __init__(
        self, fleet: Sequence[Vehicle], autopilot: Autopilot, commanders: Sequence[Commander], host: str = LOOPBACK
    ) -> None:
        """Bind all ports.

        Args:
            fleet: the vehicles, in the order of the autopilot's records.
            autopilot: holder of the records.
            commanders: one a vehicle.
            host: address to listen on; "0.0.0.0" for every network.

        Raises:
            LinkError: a port is taken; the message names vehicle, link and port. No port stays bound then.
        """
        self._autopilot = autopilot
        self._vehicles: list[_Vehicle] = []
        self._selector = selectors.EpollSelector()
        try:
            for index, (vehicle, commander) in enumerate(zip(fleet, commanders, strict=True)):
                self._vehicles.append(_Vehicle(vehicle, autopilot, commander, index, host))
        except OSError:
            self.close()
            raise
        self._links = [link for served in self._vehicles for link in served.links]
        self._stations = [served.links[-1] for served in self._vehicles]
        self._next_look = 0.0
        for served in self._vehicles:
            for link in served.links:
                self._selector.register(link.socket, selectors.EVENT_READ, (served, link))

    def fileno(self) -> int:
        """Return a descriptor that is readable when a datagram has come."""
        return self._selector.fileno()

    @property
    def next_due_us(self) -> int:
        """Simulated time, microseconds, at which ``send_streams`` has something to do next."""
        streams = min(link.streams.next_due_us for link in self._links)
        return min(streams, min(served.receiver.next_due_us for served in self._vehicles))

    @property
    def links(self) -> list[Link]:
        """All links, for their counters."""
        return self._links

    @property
    def messages(self) -> tuple[str, ...]:
        """Names of the messages that are acted on."""
        return self._vehicles[0].receiver.messages

    @property
    def sent(self) -> dict[int, int]:
        """Datagrams sent so far, by remote port."""
        totals: dict[int, int] = {}
        for link in self.links:
            for port, count in link.sent.items():
                totals[port] = totals.get(port, 0) + count
        return totals

    @property
    def received(self) -> dict[int, int]:
        """Datagrams read so far, by local port."""
        return {link.local_port: link.received for link in self.links}

    def direct(self, ports: Iterable[int], host: str, *, override: bool = False) -> None:
        """Let the links whose remote port is one of ``ports`` send to ``host`` until somebody speaks to them.

        Args:
            ports: remote ports, as the links have them at the start.
            host: address of the machine to send to.
            override: also where somebody has spoken already: he is gone.
        """
        wanted = set(ports)
        for link in self._links:
            if link.remote_port in wanted:
                link.direct(host, override=override)

    def receive(self, timeout: float = 0.0) -> int:
        """Act on all datagrams that have come, waiting up to ``timeout`` seconds of wall time for the first.

        Returns:
            How many there were.
        """
        count, full = self._receive_round(timeout)
        for _ in range(_MAX_ROUNDS - 1):
            if not full:
                break
            more, full = self._receive_round(0.0)
            count += more
        return count

    def _receive_round(self, timeout: float) -> tuple[int, bool]:
        """Give every link its turn; return how many datagrams there were, and whether some link may have more."""
        count, full = 0, False
        now_us = self._autopilot.time_us
        for key, _ in self._selector.select(timeout):
            served, link = key.data
            for _ in range(_MAX_DATAGRAMS):
                arrived = link.read()
                if arrived is None:
                    break
                served.receiver.take(link, *arrived, now_us)
                count += 1
            else:
                full = True
            link.flush(now_us)
        return count, full

    def send_streams(self, now_us: int) -> None:
        """Send the texts that wait, the telemetry that is due by ``now_us``, and what services have to say by then."""
        for served in self._vehicles:
            if served.receiver.next_due_us <= now_us:
                served.receiver.update(now_us)
            texts = served.commander.texts
            while texts:
                text = texts.popleft()
                for link in served.links:
                    if link.streams.active:
                        link.send_text(*text)
            for link in served.links:
                link.send_due(now_us)

    def keep_alive(self, counted_ports: Callable[[], Collection[int]] = tuple) -> None:
        """Keep ground stations from taking slow or paused simulated time for a lost link; call it now and then.

        Only there: what the offboard links carry is counted and the same in every run.

        Args:
            counted_ports: returns the remote ports on which lockstep participants count what comes; what goes there
                must not depend on wall time either.
        """
        wall = time.monotonic()
        if wall < self._next_look:
            return
        self._next_look = wall + _LOOK_PERIOD
        counted = counted_ports()
        for link in self._stations:
            if link.peer[1] not in counted:
                link.keep_alive(self._autopilot.time_us)

    def reboot(self, autopilot: Autopilot, commanders: Sequence[Commander]) -> None:
        """Go on with autopilots that have been rebooted: streams start anew; sockets, peers and counters stay.

        Args:
            autopilot: holder of the new records; its time may be before the old one's.
            commanders: the new ones, one a vehicle.
        """
        self._autopilot = autopilot
        for served, commander in zip(self._vehicles, commanders, strict=True):
            served.reboot(autopilot, commander)

    def hold_setpoints(self) -> None:
        """Keep what comes from topics until ``release_setpoints``; see :class:`Receiver`."""
        for served in self._vehicles:
            served.receiver.hold()

    def release_setpoints(self) -> None:
        """Act on what was kept."""
        for served in self._vehicles:
            served.receiver.release()

    def close(self) -> None:
        """Close all sockets."""
        self._selector.close()
        for served in self._vehicles:
            served.close()
