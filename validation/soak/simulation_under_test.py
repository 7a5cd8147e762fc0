"""The simulation under test: its launch, time and processes, and the nodes started and stopped beside it."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.process_use import process_tree, program
from xtdrone_interaction import command_options, simulation_services
from xtdrone_interaction.launching.process_tree import ProcessTree
from xtdrone_interaction.launching.scripted_launch import PATIENCE, StopRequest, launch_command, launch_environment

_POLL = 0.05  # s of wall time
_START_LIMIT = 300.0  # s of wall time until the first answer of the simulator
_STILL_LIMIT = 600.0  # s of wall time without progress of simulated time in a step
_READY_LIMIT = 600.0  # s of wall time until a node has joined or subscribed, on a busy machine
_END_LIMIT = 180.0  # s of wall time from the signal to the end of a node
_ANSWER_LIMIT = 300.0  # s of wall time until a service has answered
_TRIES = 60  # of a call whose request was not sent because the master did not respond in time
_BETWEEN_TRIES = 0.5  # s of wall time
_UNSENT = re.compile(r"^master: none answers|has not answered within 3 s$")
_CHUNK = 10_000_000  # us; longest single step, so that signals and samples are handled in time
_MICRO = 1_000_000


class SoakError(RuntimeError):
    """The soak cannot continue; the message gives the reason."""


def _stamp_us(stamp: Any) -> int:
    return int(stamp.secs) * _MICRO + int(stamp.nsecs) // 1000


class Stack:
    """Simulator and MAVROS layer, run by roslaunch with a master of its own.

    Attributes:
        folder: of results.
        logs: folder of roslaunch's and its nodes' logs.
        flight_logs: folder of the vehicles' ULogs.
        uri: of the master.
        stop: polled at all times.
        soak_us: simulated time of the soak, not affected by resets, us.
        concluding: whether everything is being stopped, so that no end of a process is a failure.
    """

    def __init__(self, folder: Path, count: int, seed: int, speed: float, port: int, stop: StopRequest) -> None:
        """Start the launch.

        Args:
            folder: of the results; must exist.
            count: number of vehicles.
            seed: of the simulation.
            speed: target real-time factor, 0: unlimited.
            port: of the master.
            stop: polled at all times.
        """
        self.folder = folder
        self.logs = folder / "logs"
        self.flight_logs = folder / "ulog"
        self.uri = f"http://127.0.0.1:{port}"
        self.stop = stop
        self.soak_us = 0
        self.concluding = False
        self._sim_us = 0
        self._pids: dict[str, int] = {}
        self.logs.mkdir(parents=True)
        self.flight_logs.mkdir()
        self.environment = launch_environment(port, self.logs)
        os.environ.update({k: v for k, v in self.environment.items() if k.startswith("ROS_")})  # for our own rospy
        arguments = {
            "vehicles": f"iris:{count}",
            "seed": seed,
            "speed": speed,
            "paused": "true",
            "log": self.flight_logs,
        }
        command = launch_command("multi_vehicle.launch", arguments, port)
        self._tree = ProcessTree(command, self.environment, self.logs / "roslaunch.log")
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="step")

    # ---- processes

    def check(self) -> None:
        """Check the state of the launch.

        Raises:
            SoakError: roslaunch, and with it the simulator or the MAVROS layer, has ended.
            Stopped: a signal was received.
        """
        if self.concluding:
            return
        self.stop.check()
        if self._tree.wait(0.0):
            raise SoakError(f"the simulator or the MAVROS layer has ended, see {self.logs / 'roslaunch.log'}")

    def pids(self) -> dict[str, int]:
        """Return the ids of the processes under test: simulator, mavros, rosmaster, rosout."""
        names = {"simulator": "simulator", "mavros_node": "mavros", "rosmaster": "rosmaster", "rosout": "rosout"}
        if len(self._pids) < len(names):
            for pid in process_tree(self._tree.process.pid):
                with contextlib.suppress(OSError):
                    if (name := names.get(program(pid))) is not None:
                        self._pids.setdefault(name, pid)
        return dict(self._pids)

    def end(self) -> None:
        """End the simulation through roslaunch; other processes continue."""
        if not self._tree.wait(0.0):
            self._tree.process.send_signal(signal.SIGINT)
            self._tree.wait(PATIENCE)

    def close(self) -> None:
        """End everything that was started."""
        self._tree.stop(PATIENCE)
        self._pool.shutdown(wait=False, cancel_futures=True)

    # ---- waiting

    def wait_for(self, condition: Callable[[], Any], limit: float) -> bool:
        """Poll a condition for up to ``limit`` s of wall time; return whether it became true.

        Raises:
            SoakError, Stopped: see :meth:`check`.
        """
        end = time.monotonic() + limit
        while not condition():
            self.check()
            if time.monotonic() > end:
                return False
            time.sleep(_POLL)
        return True

    def wait_until_up(self) -> None:
        """Wait until simulator and MAVROS layer are up and connected.

        Raises:
            SoakError: the time limit has expired.
        """

        def up() -> bool:
            with contextlib.suppress(simulation_services.SimError):
                return "/mavros" in self.status().participants
            return False

        if not self.wait_for(up, _START_LIMIT):
            raise SoakError(f"the simulation has not started within {_START_LIMIT:g} s, see {self.logs}")

    # ---- services and master

    def call(self, name: str, kind: Any, request: Any, limit: float | None = _ANSWER_LIMIT) -> Any:
        """Call a service, with retries while the request could not be sent; see ``simulation_services.call``.

        Raises:
            SimError: the service rejects the request, or does not respond.
            SoakError, Stopped: see :meth:`check`.
        """
        for _ in range(_TRIES):
            try:
                return simulation_services.call(self.uri, name, kind, request, limit)
            except simulation_services.SimError as error:
                if not _UNSENT.search(str(error)):
                    raise
            self.check()
            time.sleep(_BETWEEN_TRIES)
        return simulation_services.call(self.uri, name, kind, request, limit)

    def status(self) -> Any:
        """Return the SimulationStatus."""
        from xtdrone_msgs.srv import GetStatus, GetStatusRequest

        return self.call("/simulator/get_status", GetStatus, GetStatusRequest()).status

    def trigger(self, name: str) -> None:
        """Call ``/simulator/<name>``: pause or resume."""
        from std_srvs.srv import Trigger, TriggerRequest

        self.call(f"/simulator/{name}", Trigger, TriggerRequest())

    def set_speed(self, factor: float) -> None:
        """Set the target real-time factor, 0: unlimited."""
        from xtdrone_msgs.srv import SetSpeed, SetSpeedRequest

        self.call("/simulator/set_speed", SetSpeed, SetSpeedRequest(speed=factor))

    def reset(self, what: str) -> None:
        """Reset the ``simulation`` or the ``world``, between two ticks."""
        from std_srvs.srv import Empty, EmptyRequest

        self.note_time()
        self.call(f"/gazebo/reset_{what}", Empty, EmptyRequest())
        self._sim_us = _stamp_us(self.status().sim_time)

    def subscribes(self, node: str) -> bool:
        """Return whether a node has subscribed to more than the clock, according to the master."""
        proxy: Any = xmlrpc.client.ServerProxy(self.uri)
        try:
            code, _, state = proxy.getSystemState("/soak")
        except (OSError, xmlrpc.client.Error):
            return False
        return code == 1 and any(f"/{node}" in nodes for topic, nodes in state[1] if topic != "/clock")

    # ---- time

    def note_time(self) -> None:
        """Update the time after it has advanced by other means than :meth:`advance`."""
        self._pass(_stamp_us(self.status().sim_time))

    def _pass(self, sim_us: int) -> None:
        self.soak_us += max(0, sim_us - self._sim_us)
        self._sim_us = sim_us

    def advance(self, soak_us: int) -> None:
        """Advance to about ``soak_us``, by at most one chunk, and pause.

        Raises:
            SoakError: time does not advance, or the simulation has ended.
            Stopped: a signal was received.
        """
        from genpy import Time
        from xtdrone_msgs.srv import Step, StepRequest

        goal = self._sim_us + min(soak_us - self.soak_us, _CHUNK)
        request = StepRequest(until=Time(goal // _MICRO, goal % _MICRO * 1000))
        answer: Future[Any] = self._pool.submit(self.call, "/simulator/step", Step, request, None)
        try:
            self._await(answer)
            response = answer.result()
        except simulation_services.SimError as error:
            self.check()
            raise SoakError(f"step: {error}") from error
        if not response.success and _stamp_us(response.sim_time) <= self._sim_us:
            raise SoakError(f"step: {response.message}")
        self._pass(_stamp_us(response.sim_time))

    def tick(self) -> None:
        """Advance by one tick."""
        from xtdrone_msgs.srv import Step, StepRequest

        self._pass(_stamp_us(self.call("/simulator/step", Step, StepRequest(ticks=1), None).sim_time))

    def broken_step(self, length_us: int) -> None:
        """Begin a step and pause at once."""
        from genpy import Duration
        from xtdrone_msgs.srv import Step, StepRequest

        request = StepRequest(duration=Duration(length_us // _MICRO, length_us % _MICRO * 1000))
        answer = self._pool.submit(self.call, "/simulator/step", Step, request, None)
        self.wait_for(lambda: answer.done() or self.status().stepping, _READY_LIMIT)
        self.trigger("pause")
        self._await(answer)
        self.note_time()

    def _await(self, answer: Future[Any]) -> None:
        last, moved = self._sim_us, time.monotonic()
        while not answer.done():
            with contextlib.suppress(TimeoutError):
                answer.exception(timeout=0.25)
                return
            self.check()
            if time.monotonic() - moved > _STILL_LIMIT:
                status = self.status()
                if _stamp_us(status.sim_time) <= last:
                    raise SoakError(
                        f"simulated time has stood still for {_STILL_LIMIT:g} s of wall time: {status.reason}"
                    )
                last, moved = _stamp_us(status.sim_time), time.monotonic()


@dataclass
class Node:
    """A process beside the simulation.

    Attributes:
        name: of the node.
        process: of the node.
        folder: of its logs.
        participant: whether it takes part in the lockstep.
        allowed: exit statuses with which it may end without a signal.
        harmed: whether it was killed, so that its files may be truncated.
        ended: the signal sent to end it; empty before that.
    """

    name: str
    process: subprocess.Popen[bytes]
    folder: Path
    participant: bool
    allowed: Sequence[int] = (0,)
    harmed: bool = False
    ended: str = ""

    @property
    def alive(self) -> bool:
        """Whether it is running."""
        return self.process.poll() is None


class Nodes:
    """The processes that are started and stopped.

    Attributes:
        alive: by name.
        started: number of started ones by kind.
        wrong: failures: unexpected ends, late starts, bad exit statuses.
    """

    def __init__(self, stack: Stack, on_end: Callable[[Node], None]) -> None:
        """Prepare without any process.

        Args:
            stack: the simulation.
            on_end: called with each node that has ended.
        """
        self.alive: dict[str, Node] = {}
        self.started: dict[str, int] = {}
        self.wrong: list[str] = []
        self._stack = stack
        self._on_end = on_end

    def start(
        self, kind: str, name: str, command: Sequence[str], *, participant: bool = False, allowed: Sequence[int] = (0,)
    ) -> Node:
        """Start a program; its output and its ROS logs go into a folder of its own."""
        folder = self._stack.logs / "nodes" / name
        folder.mkdir(parents=True)
        environment = {**self._stack.environment, "ROS_LOG_DIR": str(folder)}
        with (folder / "output.log").open("wb") as output:
            process = subprocess.Popen(
                list(command), env=environment, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                start_new_session=True,
            )  # fmt: skip
        node = self.alive[name] = Node(name, process, folder, participant, allowed)
        self.started[kind] = self.started.get(kind, 0) + 1
        return node

    def run(self, kind: str, name: str, package: str, file: str, arguments: Sequence[str]) -> Node:
        """Start a node of the workspace that is a participant of the lockstep."""
        path = command_options.repository() / "src" / package / "nodes" / file
        return self.start(kind, name, [sys.executable, str(path), *arguments, f"__name:={name}"], participant=True)

    def await_joined(self) -> None:
        """Wait until all participants that live have joined the lockstep."""
        wanted = {f"/{node.name}" for node in self.alive.values() if node.participant}

        def joined() -> bool:
            living = {f"/{node.name}" for node in self.alive.values() if node.participant and node.alive}
            return living <= set(self._stack.status().participants)

        if not self._stack.wait_for(joined, _READY_LIMIT):
            missing = wanted - set(self._stack.status().participants)
            self.wrong.append(f"{', '.join(sorted(missing))}: not joined within {_READY_LIMIT:g} s of wall time")

    def await_subscribed(self, node: Node) -> None:
        """Wait until a listener has subscribed."""
        if not self._stack.wait_for(lambda: not node.alive or self._stack.subscribes(node.name), _READY_LIMIT):
            self.wrong.append(f"{node.name}: no subscription within {_READY_LIMIT:g} s of wall time")

    def signal(self, name: str, number: signal.Signals) -> bool:
        """Send a signal to a node; return whether it was alive."""
        node = self.alive.get(name)
        if node is None or not node.alive:
            return False
        with contextlib.suppress(ProcessLookupError):
            os.killpg(node.process.pid, number)
        return True

    def end(self, name: str, how: str) -> None:
        """End a node by the signal SIG ``how`` and wait for its end; one that has ended before is left as it is."""
        node = self.alive.get(name)
        if node is None:
            return
        if node.alive:
            node.ended = how
            node.harmed = how != "INT"
            self.signal(name, signal.Signals[f"SIG{how}"])
            if not self._stack.wait_for(lambda: not node.alive, _END_LIMIT):
                self.wrong.append(f"{name}: not ended within {_END_LIMIT:g} s of wall time after SIG{how}")
                node.harmed = True
                self.signal(name, signal.SIGKILL)
                node.process.wait()
        self.collect()

    def collect(self) -> None:
        """Register the nodes that have ended."""
        for node in [node for node in self.alive.values() if not node.alive]:
            del self.alive[node.name]
            status = node.process.returncode
            if not node.ended and status not in node.allowed:
                self.wrong.append(f"{node.name}: ended by itself with status {status}, see {node.folder}")
            self._on_end(node)

    def end_all(self) -> None:
        """End all: participants as roslaunch does, the others likewise."""
        for node in list(self.alive.values()):
            if node.alive:
                node.ended = node.ended or "INT"
                self.signal(node.name, signal.SIGINT)
        for name in list(self.alive):
            self.end(name, "INT")
