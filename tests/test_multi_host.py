"""One system on several hosts: the same flight to the last bit over a poor wire, and hosts that fail.

Hosts are namespaces, see ``network``. Run as a program, this file is a node: the pilot of the flight whose MAVROS
layer is on another host.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import network
import pytest
from network import Host, Network, Program

REPOSITORY = Path(__file__).resolve().parents[1]
PORT = 11311
WALL_LIMIT = 180.0  # s; longest wait for anything, on a busy machine
FLIGHT = ("n:=3", "patterns:=triangle", "speed:=0")
LENGTH = 14.0  # s of simulated time: takeoff, and 6 s in formation
POOR = {"delay": 0.005, "jitter": 0.003, "loss": 0.005}
CUT_TIME = 10.0  # s of simulated time, in formation
SILENCE = 4.0  # s of wall time until a silent host counts as lost
HEIGHT = 1.5  # m above the ground; AUTO.TAKEOFF ends higher
_POLL = 0.1  # s between polls of logs and files

_REASON = network.why_not()
pytestmark = pytest.mark.skipif(bool(_REASON), reason=_REASON)

Line = tuple[str, int]
"""Who says it, and at which simulated time, us."""


class Site:
    """Hosts with one ROS master, on the first of them, and their programs."""

    def __init__(self, net: Network, folder: Path) -> None:
        self.net = net
        self.hosts = net.hosts
        self.folder = folder
        self.digest = folder / "digest.jsonl"

    def run(self, host: Host, name: str, *command: str) -> Program:
        """Start a program on a host as a user would, given only the master's address and the host's own."""
        environment = {key: value for key, value in os.environ.items() if key != "ROS_HOSTNAME"}
        environment |= {
            "ROS_MASTER_URI": f"http://{self.hosts[0].address}:{PORT}",
            "ROS_IP": host.address,
            "ROS_LOG_DIR": str(self.folder / host.name),
            "PYTHONUNBUFFERED": "1",
        }
        return host.run(name, command, environment, self.folder / f"{name}.log")

    def launch(self, host: Host, file: str, *arguments: str) -> Program:
        """Start a launch file; away from the master's host it waits for the master."""
        wait = [] if host is self.hosts[0] else ["--wait"]
        name = f"{host.name} {file}"
        return self.run(host, name, "roslaunch", *wait, str(REPOSITORY / "launch" / file), *arguments)

    def lines(self) -> dict[Line, dict[str, list[int]]]:
        """Return the digest file's latest entries: topics with messages, bytes and checksum."""
        if not self.digest.exists():
            return {}
        *whole, _ = self.digest.read_text(encoding="utf-8").split("\n")
        return {(line["name"], line["time"]): line["topics"] for line in map(json.loads, whole)}

    def time(self, name: str = "/simulator") -> float:
        """Return the simulated time, s, of the last line of a node in the digest file; 0 before the first."""
        return max((time_us for who, time_us in self.lines() if who == name), default=0) * 1e-6

    def wait(self, condition: Callable[[], Any], what: str, launch: Program, limit: float = WALL_LIMIT) -> None:
        """Wait until ``condition`` holds; ``launch`` must keep running."""
        end = time.monotonic() + limit
        while not condition():
            assert launch.status is None, f"{what}: {launch.name} has ended:\n{self.logs()}"
            assert time.monotonic() < end, f"{what}: not within {limit:g} s; at {self.time():.2f} s:\n{self.logs()}"
            time.sleep(_POLL)

    def logs(self) -> str:
        """Return the last output of all programs."""
        programs = [program for host in self.hosts for program in host.programs]
        return "\n".join(f"--- {program.name}\n{program.output[-1500:]}" for program in programs)


def fly(net: Network, folder: Path) -> Site:
    """Fly the formation for a while, the vehicles' nodes on the last host, all others on the first."""
    site = Site(net, folder)
    first, last = site.hosts[0], site.hosts[-1]
    split = first is not last
    here = ["host:=0.0.0.0", "last:=-1"] if split else []
    programs = [site.launch(first, "formation.launch", *FLIGHT, f"digest:={site.digest}", *here)]
    if split:
        programs.append(site.launch(last, "formation.launch", *FLIGHT, "main:=false"))
    site.wait(lambda: site.time() >= LENGTH, f"{LENGTH} s are flown", programs[0])
    programs[0].interrupt()
    for program in programs:  # the nodes on the last host end by themselves, without their simulator
        assert program.end(WALL_LIMIT) == 0, program.output[-3000:]
    return site


def test_the_flight_on_two_hosts_with_a_poor_wire_is_that_on_one_to_the_last_bit(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("alone", "two")]
    for folder in folders:
        folder.mkdir()
    with Network(1) as net:
        alone = fly(net, folders[0])
    with Network(2, **POOR, seed=1) as net:
        two = fly(net, folders[1])
        counters = net.counters()
        output = "".join(path.read_text(encoding="utf-8") for path in folders[1].glob("host1/*/simulator*.log"))
    assert "participant /follower_2 joins at 30 Hz from 10.77.0.2" in output
    assert counters["lost_tcp"] > 0, counters

    until = min(alone.time(), two.time()) * 1e6
    expected = {line: topics for line, topics in alone.lines().items() if line[1] <= until}
    found = {line: topics for line, topics in two.lines().items() if line[1] <= until}
    # Messages at the end are recorded on arrival, and the last line ends where the flight was ended.
    last = (until // 1_000_000 - 1) * 1_000_000
    assert {line for line in expected if line[1] <= last} == {line for line in found if line[1] <= last}
    differences = [
        (line, topic)
        for line in sorted((line for line in expected if line[1] <= last), key=lambda entry: entry[1])
        for topic in expected[line]
        if expected[line][topic] != found[line].get(topic)
    ]
    assert not differences, differences[:5]
    names = {name for name, _ in expected}
    assert len(names) == 9  # simulator, MAVROS, leader, director, three communication nodes, two followers
    flown = expected["/follower_1", max(time_us for name, time_us in expected if name == "/follower_1")]
    assert flown["/xtdrone/iris_1/cmd_vel_enu"][0] > 100


def test_mavros_on_another_host_flies_on_when_datagrams_get_lost(tmp_path: Path) -> None:
    with Network(2, delay=0.005, jitter=0.003, loss=0.01, seed=2) as net:
        site = Site(net, tmp_path)
        first, second = site.hosts
        launch = site.launch(
            first, "multi_vehicle.launch", "vehicles:=iris:2", "rows:=2", "speed:=0", "host:=0.0.0.0",
            "mavros:=elsewhere", "participants:=3", f"digest:={site.digest}",
        )  # fmt: skip
        layer = site.launch(second, "mavros.launch", f"fcu_host:={first.address}")
        node = REPOSITORY / "src/xtdrone_control/nodes/multirotor_communication.py"
        site.wait(lambda: "process[simulator" in launch.output, "the parameters are set", launch)
        site.run(first, "communication", sys.executable, str(node), "iris", "all")
        pilot = site.run(first, "pilot", sys.executable, __file__)
        # each lost datagram holds the simulation for about a second of wall time
        site.wait(lambda: pilot.status is not None, "the pilot has landed", launch, 3 * WALL_LIMIT)
        assert pilot.status == 0, site.logs()
        counters = net.counters()
        launch.interrupt()
        launch.end(WALL_LIMIT)
        layer.end(WALL_LIMIT)
    phases = [line for line in pilot.output.splitlines() if line.startswith("pilot: ")]
    assert [phase.split()[1] for phase in phases] == ["connect", "takeoff", "hover", "land", "landed"], phases
    assert counters["lost_udp"] > 0
    reports = [
        line for line in (launch.output + layer.output).splitlines() if "datagrams" in line and "UDP port" in line
    ]
    assert reports, site.logs()
    assert any(str(port) in report for report in reports for port in (24540, 24541, 34580, 34581)), reports
    assert "dropped" not in launch.output


def test_a_lost_host_removes_only_its_participants(tmp_path: Path) -> None:
    """One host is cut off, all processes of the other are killed: the flight continues with the remaining follower."""
    with Network(3) as net:
        site = Site(net, tmp_path)
        first, second, third = site.hosts
        arguments = ("n:=4", *FLIGHT[1:], f"hang_limit:={SILENCE:g}")
        main = site.launch(
            first, "formation.launch", *arguments, "host:=0.0.0.0", "last:=1", f"digest:={site.digest}"
        )  # fmt: skip
        site.launch(second, "formation.launch", *arguments, "main:=false", "first:=2", "last:=2")
        site.launch(third, "formation.launch", *arguments, "main:=false", "first:=3")
        site.wait(lambda: site.time() >= CUT_TIME, f"{CUT_TIME} s are flown", main)
        net.cut(third)
        second.kill_all()
        gone = [f"/{name}{i}{kind}" for i in (2, 3) for name, kind in (("follower_", ""), ("iris_", "_communication"))]

        def dropped() -> list[str]:
            lines = [line for line in main.output.splitlines() if "dropped, the simulation goes on" in line]
            return sorted(name for line in lines for name in gone if f" participant {name} " in line)

        site.wait(lambda: len(dropped()) >= len(gone), f"the simulator misses {gone}", main)
        begin = site.time()
        site.wait(
            lambda: min(site.time(name) for name in ("/mavros", "/leader", "/iris_0_communication")) >= begin + 3.0,
            "the others fly on",
            main,
        )
        main.interrupt()
        main.end(WALL_LIMIT)
        assert dropped() == sorted(gone)
        assert main.output.count("dropped, the simulation goes on") == len(gone)


# ---- the hosts and the wire themselves

_ECHO = """
import socket
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.bind(("0.0.0.0", 5000))
print("bound", flush=True)
while True:
    sock.sendto(*sock.recvfrom(100))
"""
_ASK = """
import socket, sys, time
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.settimeout(1.0)
sock.connect((sys.argv[1], 5000))
sent = [time.monotonic()]
sock.send(b"0")
sock.recv(100)  # the way is known now: no later one waits for it
for number in range(1, int(sys.argv[2])):
    sent.append(time.monotonic())
    sock.send(b"%d" % number)
while True:
    try:
        number = int(sock.recv(100))
    except TimeoutError:
        break
    print(number, time.monotonic() - sent[number])
"""


def _answers(net: Network, folder: Path, count: int) -> dict[int, float]:
    """Return the round-trip times in s of those of ``count`` datagrams that come back from the second host."""
    first, second = net.hosts
    echo = second.run("echo", [sys.executable, "-u", "-c", _ECHO], os.environ, folder / "echo.log")
    while "bound" not in echo.output:
        assert echo.status is None, echo.output
        time.sleep(_POLL)
    ask = first.run("ask", [sys.executable, "-c", _ASK, second.address, str(count)], os.environ, folder / "ask.log")
    assert ask.end(WALL_LIMIT) == 0, ask.output
    echo.kill()
    assert echo.end(WALL_LIMIT) == -signal.SIGKILL
    return {int(number): float(seconds) for number, seconds in map(str.split, ask.output.splitlines())}


def test_the_wire_delays_reorders_and_loses(tmp_path: Path) -> None:
    with Network(2, delay=0.005, jitter=0.003, loss=0.1, seed=3) as net:
        times = _answers(net, tmp_path, 300)
        counters = net.counters()
    assert min(times.values()) >= 2 * 0.002
    assert max(times.values()) - min(times.values()) > 0.003
    assert list(times) != sorted(times)
    assert 299 - len(times) == counters["lost_udp"]  # a request or its reply
    assert counters["lost_udp"] == pytest.approx(300 * 0.19, abs=4 * math.sqrt(300 * 0.19))


def test_a_cut_cable_passes_nothing(tmp_path: Path) -> None:
    with Network(2) as net:
        assert len(_answers(net, tmp_path, 4)) == 3
        net.cut(net.hosts[1])
        with pytest.raises(AssertionError, match="TimeoutError"):
            _answers(net, tmp_path, 1)
        assert net.counters()["cut"] >= 1


def test_nothing_is_left_when_its_maker_is_killed() -> None:
    script = (
        "import os, sys, network\n"
        "net = network.Network(2)\n"
        "net.hosts[0].run('sleep', ['sleep', '1000'], os.environ, network.Path(os.devnull))\n"
        "while not net.hosts[0].processes(): pass\n"
        "print(*[host.pid for host in net.hosts], *net.hosts[0].processes(), flush=True)\n"
        "sys.stdin.read()\n"
    )
    maker = subprocess.Popen(
        [sys.executable, "-c", script],
        cwd=Path(__file__).parent,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert maker.stdout is not None
    processes = [Path(f"/proc/{pid}") for pid in maker.stdout.readline().split()]
    assert len(processes) >= 3
    assert all(process.exists() for process in processes)
    maker.kill()
    maker.communicate()
    end = time.monotonic() + WALL_LIMIT
    while any(process.exists() for process in processes):
        assert time.monotonic() < end, processes
        time.sleep(_POLL)


# ---- the pilot


class Pilot:
    """Has every vehicle take off, hover for a while and land, by XTDrone's commands; repeats those without effect."""

    def __init__(self, names: Sequence[str]) -> None:
        """Declare the topics."""
        from geometry_msgs.msg import PoseStamped
        from mavros_msgs.msg import State
        from std_msgs.msg import String

        import xtdrone_lockstep as lockstep

        self._string = String
        self._names = names
        self._commands = {name: lockstep.Publisher(f"/xtdrone/{name}/cmd", String) for name in names}
        self._states: dict[str, Any] = dict.fromkeys(names)
        self._heights = dict.fromkeys(names, math.nan)
        for name in names:
            lockstep.Subscriber(f"/{name}/mavros/state", State, self._on_state, name)
            lockstep.Subscriber(f"/{name}/mavros/local_position/pose", PoseStamped, self._on_pose, name)

    def _on_state(self, message: Any, name: str) -> None:
        self._states[name] = message

    def _on_pose(self, message: Any, name: str) -> None:
        self._heights[name] = message.pose.position.z

    def fly(self) -> Iterator[None]:
        """Advance once a turn."""
        yield from self._until("connect", lambda s, _: s is not None and s.connected)
        yield from self._until("takeoff", lambda s, h: s.armed and h > HEIGHT, "AUTO.TAKEOFF", "ARM")
        yield from self._until("hover", lambda s, _: s.mode == "AUTO.LOITER")
        yield from self._until("land", lambda s, _: not s.armed, "AUTO.LAND")
        print("pilot: landed", flush=True)

    def _until(self, phase: str, reached: Callable[[Any, float], bool], *commands: str) -> Iterator[None]:
        print(f"pilot: {phase}", flush=True)
        for turn in range(30 * 40):
            missing = [name for name in self._names if not reached(self._states[name], self._heights[name])]
            if not missing:
                return
            if turn % 30 == 0:
                for name in missing:
                    for command in commands:
                        if command != "ARM" or not self._states[name].armed:
                            self._commands[name].publish(self._string(command))
            yield
        raise SystemExit(f"{phase}: not within 40 s: {missing}")


def main() -> None:
    """Run the pilot."""
    import rospy

    import xtdrone_lockstep as lockstep
    from xtdrone_common.fleet import parse_fleet

    lockstep.init_node("pilot", rate=30)
    pilot = Pilot([vehicle.name for vehicle in parse_fleet(rospy.get_param("/xtdrone/fleet"))])
    lockstep.start()
    rate = lockstep.Rate()
    for _ in pilot.fly():
        rate.sleep()


if __name__ == "__main__":
    main()
