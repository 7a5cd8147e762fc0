"""Several hosts with a network between them, on one machine: for tests of distributed systems.

A host is a network and a process namespace with one network card, a TAP device. A separate process, the *wire* (this
file run as a program), holds the other ends of all TAP devices and passes Ethernet frames between them like a
switch, with a delay and a loss for each frame, drawn from a seeded generator. Frames whose delays differ overtake each
other. So TCP has to retransmit and to reorder, and UDP datagrams are lost, as on a poor wireless link.

The wire stands for ``tc qdisc add dev eth0 root netem delay 5ms 3ms loss 0.5%``, which does the same inside the kernel,
but which not every kernel has: here namespaces and TAP devices are enough.

Everything ends with the process that created it, even if that is killed: a host's first process and the wire end when
their standard input closes, with a host's first process the kernel kills all others of that host, and TAP devices and
namespaces without a process are no more. Linux only; root rights are needed.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import ctypes
import errno
import fcntl
import heapq
import itertools
import json
import os
import random
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

START_LIMIT = 120.0  # s of wall time
PROGRAMS = ("unshare", "nsenter")
_PREFIX = "10.77.0."
_POLL = 0.02  # s between polls

# <linux/if_tun.h>, <linux/sockios.h>, <linux/if.h>, <linux/sched.h>
_TUNSETIFF, _IFF_TAP, _IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
_SIOCSIFFLAGS, _SIOCSIFADDR, _SIOCSIFNETMASK, _SIOCSIFTXQLEN = 0x8914, 0x8916, 0x891C, 0x8943
_IFF_UP = 0x1
_CLONE_NEWNET = 0x40000000
_QUEUE = 5000  # frames that wait for the wire
_MAX_FRAME = 65536
_BATCH = 64  # frames read from one host before the others have their turn


class NetworkError(RuntimeError):
    """Hosts or wire cannot be created, or have ended."""


def why_not() -> str:
    """Return why no network can be created here; empty if it can."""
    if not sys.platform.startswith("linux"):
        return "network namespaces are Linux's"
    if os.geteuid() != 0:
        return "network namespaces and TAP devices need root's rights"
    absent = [name for name in PROGRAMS if shutil.which(name) is None]
    if absent:
        return f"{', '.join(absent)} of util-linux not found"
    try:
        os.close(os.open("/dev/net/tun", os.O_RDWR))
    except OSError as error:
        return f"no TAP devices: /dev/net/tun: {error.strerror}"
    probe = subprocess.run(
        ["unshare", "--net", "--pid", "--fork", "true"],
        capture_output=True,
        text=True,
        timeout=START_LIMIT,
        check=False,
    )
    return "" if probe.returncode == 0 else f"no namespaces: {probe.stderr.strip()}"


# ---- hosts and their programs


class Program:
    """A program on a host.

    Attributes:
        name: for logs and failures.
        log: file with the program's output.
    """

    def __init__(
        self, host: Host, name: str, command: Sequence[str], environment: Mapping[str, str], log: Path
    ) -> None:
        self.name = name
        self.log = log
        self._pid = 0
        spaces = ("--net", "--pid", "--mount", "--uts")
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                ["nsenter", f"--target={host.pid}", *spaces, "--wd=.", "--", *command],
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    @property
    def output(self) -> str:
        """The output so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    @property
    def status(self) -> int | None:
        """The exit status, None while the program runs."""
        return self._process.poll()

    def interrupt(self) -> None:
        """Interrupt the program, as Ctrl-C does."""
        self._signal(signal.SIGINT)

    def kill(self) -> None:
        """Kill the program, as ``kill -9`` does."""
        self._signal(signal.SIGKILL)

    def end(self, limit: float) -> int:
        """Wait up to ``limit`` s for the program's end and return the exit status.

        Raises:
            NetworkError: it is still running.
        """
        try:
            return self._process.wait(limit)
        except subprocess.TimeoutExpired as error:
            raise NetworkError(f"{self.name} has not ended within {limit:g} s:\n{self.output[-3000:]}") from error

    def _signal(self, number: int) -> None:
        """Send a signal to the program itself: nsenter is its parent and passes none on."""
        with contextlib.suppress(ProcessLookupError):
            if not self._pid:
                self._pid = _only_child(self._process)
            os.kill(self._pid, number)


class Host:
    """A machine: an address and processes that see no others.

    Attributes:
        name: host name.
        address: IPv4 address on the network.
        pid: its first process, which only keeps the host alive.
    """

    def __init__(self, name: str, address: str) -> None:
        """Create the host, without its network card.

        Raises:
            NetworkError: namespaces cannot be created.
        """
        self.name = name
        self.address = address
        self.programs: list[Program] = []
        script = f"echo {name} >/proc/sys/kernel/hostname && echo ready && exec cat"
        self._keeper = subprocess.Popen(
            ["unshare", "--net", "--pid", "--uts", "--mount-proc", "--fork", "--kill-child", "sh", "-c", script],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert self._keeper.stdout is not None
        if self._keeper.stdout.readline() != b"ready\n":
            raise NetworkError(f"host {name}: no namespaces (unshare ended with {self._keeper.wait()})")
        self.pid = _only_child(self._keeper)

    def run(self, name: str, command: Sequence[str], environment: Mapping[str, str], log: Path) -> Program:
        """Start a program on this host, in the current folder."""
        program = Program(self, name, command, environment, log)
        self.programs.append(program)
        return program

    def processes(self) -> list[int]:
        """Return the ids, as seen from outside, of all processes but the first."""
        space = os.readlink(f"/proc/{self.pid}/ns/pid")
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit() and int(entry.name) != self.pid:
                with contextlib.suppress(OSError):  # it has ended
                    if os.readlink(entry / "ns" / "pid") == space:
                        found.append(int(entry.name))
        return found

    def kill_all(self) -> None:
        """Kill every process but the first; the network card stays, so that their connections are closed.

        The youngest are killed first: a node before its launcher and roslaunch, whose end would shut it down in order.
        """
        for pid in sorted(self.processes(), reverse=True):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def close(self) -> None:
        """End the host and all its processes."""
        assert self._keeper.stdin is not None
        assert self._keeper.stdout is not None
        self._keeper.stdin.close()
        try:
            self._keeper.wait(5.0)
        except subprocess.TimeoutExpired:
            self._keeper.kill()
            self._keeper.wait()
        self._keeper.stdout.close()
        for program in self.programs:
            program.end(5.0)


def _only_child(process: subprocess.Popen[Any]) -> int:
    """Return the id of the process forked by unshare or nsenter, once it exists."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    end = time.monotonic() + START_LIMIT
    while time.monotonic() < end:
        try:
            found = children.read_text(encoding="ascii").split()
        except OSError:
            break
        if found:
            return int(found[0])
        if process.poll() is not None:
            break
        time.sleep(_POLL)
    raise ProcessLookupError(f"{process.args!r} has no child")


class Network:
    """Hosts on one wire.

    Attributes:
        hosts: with addresses 10.77.0.1, 10.77.0.2, ...
    """

    def __init__(
        self, count: int = 2, *, delay: float = 0.0, jitter: float = 0.0, loss: float = 0.0, seed: int = 0
    ) -> None:
        """Create hosts and wire.

        Args:
            count: number of hosts.
            delay: mean time that a frame takes, s.
            jitter: half the width of the uniform distribution of that time, s.
            loss: share of frames that are lost, 0 to 1.
            seed: of the random delays and losses.

        Raises:
            NetworkError: it cannot be created.
        """
        self.hosts: list[Host] = []
        self._wire: subprocess.Popen[str] | None = None
        try:
            for number in range(1, count + 1):
                self.hosts.append(Host(f"host{number}", f"{_PREFIX}{number}"))
            options = {"delay": delay, "jitter": jitter, "loss": loss, "seed": seed}
            self._wire = subprocess.Popen(
                [
                    *(sys.executable, __file__),
                    *itertools.chain.from_iterable((f"--{name}", str(value)) for name, value in options.items()),
                    *(f"{host.pid}:{host.address}" for host in self.hosts),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
            self._ask("counters")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Network:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def counters(self) -> dict[str, int]:
        """Return numbers of frames so far: ``forwarded``, ``cut``, ``full``, and by protocol ``lost_tcp`` and so on."""
        return self._ask("counters")

    def cut(self, host: Host) -> None:
        """Cut a host off: no more frames to it or from it."""
        self._ask("cut", host.pid)

    def close(self) -> None:
        """End hosts and wire."""
        for host in self.hosts:
            host.close()
        self.hosts.clear()
        wire, self._wire = self._wire, None
        if wire is not None:
            assert wire.stdin is not None
            assert wire.stdout is not None
            with contextlib.suppress(BrokenPipeError):
                wire.stdin.close()
            try:
                wire.wait(5.0)
            except subprocess.TimeoutExpired:
                wire.kill()
                wire.wait()
            wire.stdout.close()

    def _ask(self, *request: Any) -> dict[str, int]:
        if self._wire is None:
            raise NetworkError("the network is closed")
        assert self._wire.stdin is not None
        assert self._wire.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._wire.stdin.write(json.dumps(request) + "\n")
            self._wire.stdin.flush()
        answer = self._wire.stdout.readline()
        if not answer:
            raise NetworkError(f"the wire has ended with status {self._wire.wait()}")
        return dict(json.loads(answer))


# ---- the wire


def _check(result: int, what: str) -> None:
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")


class Card:
    """The wire's end of a host's network card."""

    def __init__(self, pid: int, address: str, generator: random.Random) -> None:
        """Create the TAP device ``eth0`` in the host's network namespace, with an address of a /24 network; both up.

        Raises:
            OSError: it cannot be created.
        """
        self.pid = pid
        self.generator = generator
        self.cut = False
        libc = ctypes.CDLL(None, use_errno=True)
        with open("/proc/self/ns/net", "rb") as home, open(f"/proc/{pid}/ns/net", "rb") as there:
            _check(libc.setns(there.fileno(), _CLONE_NEWNET), f"namespace of process {pid}")
            try:
                self.descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
                request = struct.pack("16sH22x", b"eth0", _IFF_TAP | _IFF_NO_PI)
                fcntl.ioctl(self.descriptor, _TUNSETIFF, request)
                self._configure(address)
            finally:
                _check(libc.setns(home.fileno(), _CLONE_NEWNET), "own namespace")

    @staticmethod
    def _configure(address: str) -> None:
        # Neighbour discovery and the like would only be noise on the wire.
        with contextlib.suppress(OSError):
            Path("/proc/sys/net/ipv6/conf/all/disable_ipv6").write_text("1", encoding="ascii")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            for request, value in ((_SIOCSIFADDR, address), (_SIOCSIFNETMASK, "255.255.255.0")):
                inet = struct.pack("HH4s8x", socket.AF_INET, 0, socket.inet_aton(value))
                fcntl.ioctl(sock, request, struct.pack("16s16s8x", b"eth0", inet))
            fcntl.ioctl(sock, _SIOCSIFTXQLEN, struct.pack("16si20x", b"eth0", _QUEUE))
            for name in (b"lo", b"eth0"):
                fcntl.ioctl(sock, _SIOCSIFFLAGS, struct.pack("16sH22x", name, _IFF_UP))


class Wire:
    """Passes frames between cards until its standard input ends, and executes the requests written there."""

    def __init__(self, cards: Sequence[Card], delay: float, jitter: float, loss: float) -> None:
        """Keep the cards; delay and jitter in s, loss from 0 to 1."""
        self._cards = list(cards)
        self._least, self._spread, self._loss = delay - jitter, 2.0 * jitter, loss
        self._counters: collections.Counter[str] = collections.Counter(forwarded=0)
        self._places: dict[bytes, Card] = {}
        self._under_way: list[tuple[float, int, Card, bytes]] = []
        self._number = itertools.count()
        self._rest = b""

    def run(self) -> None:
        """Pass frames until standard input ends."""
        poller = select.epoll()
        poller.register(0, select.EPOLLIN)
        by_descriptor = {card.descriptor: card for card in self._cards}
        for descriptor in by_descriptor:
            poller.register(descriptor, select.EPOLLIN)
        while True:
            for descriptor, _ in poller.poll(self._until_next()):
                card = by_descriptor.get(descriptor)
                if card is not None:
                    self._read(card)
                elif not self._obey():
                    return
            self._deliver_due()

    def _until_next(self) -> float | None:
        if not self._under_way:
            return None
        return max(0.0, self._under_way[0][0] - time.monotonic())

    def _read(self, card: Card) -> None:
        for _ in range(_BATCH):
            try:
                frame = os.read(card.descriptor, _MAX_FRAME)
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno == errno.EIO:  # the card is down
                    return
                raise
            self._take(card, frame)

    def _take(self, card: Card, frame: bytes) -> None:
        """Schedule a frame: for the card with its destination, or for all others."""
        self._places[frame[6:12]] = card
        place = self._places.get(frame[:6])
        others = [other for other in self._cards if other is not card] if place is None else [place]
        generator = card.generator
        for other in others:
            # Both are drawn each time, so that one frame's fate does not affect another's.
            lost, late = generator.random() < self._loss, self._least + self._spread * generator.random()
            if card.cut or other.cut:
                self._counters["cut"] += 1
            elif lost:
                self._counters[f"lost_{_protocol(frame)}"] += 1
            elif late > 0.0:
                heapq.heappush(self._under_way, (time.monotonic() + late, next(self._number), other, frame))
            else:
                self._deliver(other, frame)

    def _deliver_due(self) -> None:
        now = time.monotonic()
        while self._under_way and self._under_way[0][0] <= now:
            _, _, card, frame = heapq.heappop(self._under_way)
            if card.cut:
                self._counters["cut"] += 1
            else:
                self._deliver(card, frame)

    def _deliver(self, card: Card, frame: bytes) -> None:
        try:
            os.write(card.descriptor, frame)
        except OSError as error:
            if error.errno not in {errno.EAGAIN, errno.EIO, errno.ENOBUFS}:
                raise
            self._counters["full"] += 1
            return
        self._counters["forwarded"] += 1

    def _obey(self) -> bool:
        """Reply to requests, each a line; return False at the end of the input."""
        data = os.read(0, 4096)
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            what, *arguments = json.loads(line)
            if what == "cut":
                for card in self._cards:
                    card.cut = card.cut or card.pid in arguments
            print(json.dumps(self._counters), flush=True)
        return bool(data)


def _protocol(frame: bytes) -> str:
    if frame[12:14] != b"\x08\x00":
        return "other"
    return {6: "tcp", 17: "udp"}.get(frame[23], "other")


def main() -> int:
    """Run the wire."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # its creator ends it
    parser = argparse.ArgumentParser(description=main.__doc__)
    for name in ("delay", "jitter", "loss"):
        parser.add_argument(f"--{name}", type=float, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("cards", nargs="+", help="process in the namespace:address")
    options = parser.parse_args()
    cards = []
    for number, card in enumerate(options.cards):
        pid, address = card.split(":")
        cards.append(Card(int(pid), address, random.Random(f"{options.seed} {number}")))
    with contextlib.suppress(BrokenPipeError):
        Wire(cards, options.delay, options.jitter, options.loss).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
