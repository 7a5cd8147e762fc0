#!/usr/bin/env python3
"""Node that measures how fast a formation flight can be simulated, in lockstep or free-running.

A plain rospy node outside the lockstep. It waits until the formation flies, then measures windows of wall time: in
lockstep one, at unlimited speed; free-running one for each speed of the search
(:mod:`benchmarks.nodes.free_running_speeds`), set by /simulator/set_speed.

Parameters:
    ~plan: JSON file with the plan: ``window`` (s of wall time) and, free-running only, ``exact`` (``real_time_factor``
        and ``rates`` of the flight in lockstep) and ``trials`` (those of earlier flights).
    ~out: folder for events.jsonl.

events.jsonl has the director's format: ``start``, then ``window`` (``real_time_factor``, ``rates``: messages per
simulated s by role, ``cpu``: CPU s per simulated s by program, ``others_cpu``) or, for each speed, ``trying``
(``speed``) and ``trial`` (the fields of :class:`~benchmarks.nodes.free_running_speeds.Trial`), and finally ``done`` or
``failed`` (``reason``).

Exit status: 0 after a measurement, 1 after a failed one.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

import rosgraph
import rospy
from std_msgs.msg import String
from xtdrone_msgs.srv import SetSpeed

from benchmarks.nodes import bus_statistics
from benchmarks.nodes.free_running_speeds import Trial, next_speed
from benchmarks.process_use import CpuSample
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_interaction.recording.topics import EVENTS_TOPIC

_FIRST_PHASE = "climb"  # from this phase on all followers publish commands
_ENDS = {"failed", "giving up", "interrupted", "done"}
SETTLING = 1.0  # s of wall time between a change of speed and the measurement
_APPROACH = 0.7  # of the speed in lockstep: speed of the takeoff of a free-running flight
_SLICE = 0.2  # s of wall time between checks for a shutdown


class ProbeError(RuntimeError):
    """The measurement cannot continue; the message gives the reason."""


@dataclass(frozen=True)
class Window:
    """Figures of a window of time; see the events of the module."""

    real_time_factor: float
    rates: dict[str, float]
    cpu: dict[str, float]
    others_cpu: float


class SpeedProbe:
    """Measurement of one flight, written as events."""

    def __init__(self, plan: Mapping[str, Any], events: TextIO) -> None:
        """Subscribe to the director's events.

        Args:
            plan: see the module.
            events: receives the events as JSON lines.
        """
        self._plan = plan
        self._events = events
        self._window = float(plan["window"])
        self._master = rosgraph.Master(rospy.get_name())
        self._set_speed = rospy.ServiceProxy("/simulator/set_speed", SetSpeed)
        self._armed = threading.Event()
        self._flying = threading.Event()
        self._ended = threading.Event()
        self._end = ""
        rospy.Subscriber(EVENTS_TOPIC, String, self._on_event)

    def run(self) -> int:
        """Measure and return the exit status of the program: 0, or 1 if it failed."""
        self._event("start")
        try:
            self._measure()
        except ProbeError as error:
            self._event("failed", reason=str(error))
            return 1
        except (rospy.ROSException, rospy.ServiceException, rosgraph.MasterException, OSError) as error:
            self._event(
                "failed", reason=f"{type(error).__name__}: {error}; {self._end or 'no message from the director'}"
            )
            return 1
        self._event("done")
        return 0

    def _on_event(self, message: String) -> None:
        """Store the director's event; called in a rospy thread."""
        event = json.loads(message.data)
        if event["event"] in _ENDS:
            self._end = f"the flight has ended: {event['event']} {event.get('reason', '')}".rstrip()
            self._ended.set()
        if event["event"] == "armed":
            self._armed.set()
        if event.get("phase") == _FIRST_PHASE:
            self._flying.set()

    def _measure(self) -> None:
        exact = self._plan.get("exact")
        if exact is None:
            self._await(self._flying)
            self._wait(SETTLING)
            self._event("window", **asdict(self._measure_window()))
            return
        trials = [Trial(**trial) for trial in self._plan["trials"]]
        self._await(self._armed)
        self._change_speed(_APPROACH * exact["real_time_factor"])
        self._await(self._flying)
        while (speed := next_speed(exact["real_time_factor"], trials)) is not None:
            trials.append(self._try(speed, exact["rates"]))

    def _try(self, speed: float, exact_rates: Mapping[str, float]) -> Trial:
        self._event("trying", speed=speed)
        self._change_speed(speed)
        self._wait(SETTLING)
        window = self._measure_window()
        turns = {role: window.rates.get(role, 0.0) / rate for role, rate in exact_rates.items()}
        trial = Trial(speed, window.real_time_factor, turns, window.cpu, window.others_cpu)
        self._event("trial", **asdict(trial))
        return trial

    def _measure_window(self) -> Window:
        """Measure for the window and return its figures.

        Raises:
            ProbeError: the flight ends, or simulated time does not advance.
        """
        root = os.getppid()  # roslaunch
        roles = bus_statistics.publishers(self._master)
        counts = bus_statistics.take(self._master, roles, rospy.get_time)
        start, start_wall, cpu = rospy.get_time(), time.perf_counter(), CpuSample.take(root)
        self._wait(self._window)
        simulated, elapsed = rospy.get_time() - start, time.perf_counter() - start_wall
        use = CpuSample.take(root).since(cpu)
        rates = bus_statistics.rates(roles, counts, bus_statistics.take(self._master, roles, rospy.get_time))
        if simulated <= 0.0 or not rates:
            raise ProbeError(f"simulated time advanced by {simulated:.3f} s within {elapsed:.1f} s; rates: {rates}")
        programs = {name: seconds / simulated for name, seconds in use.programs.items()}
        return Window(simulated / elapsed, rates, programs, use.others / elapsed)

    def _change_speed(self, speed: float) -> None:
        answer = self._set_speed(speed)
        if not answer.success:
            raise ProbeError(f"speed: {answer.message}")

    def _await(self, happened: threading.Event) -> None:
        """Wait for an event.

        Raises:
            ProbeError: the flight ends.
        """
        while not happened.wait(_SLICE):
            self._check()

    def _wait(self, seconds: float) -> None:
        """Wait for a wall time.

        Raises:
            ProbeError: the flight ends.
        """
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0.0:
            self._ended.wait(min(remaining, _SLICE))
            self._check()

    def _check(self) -> None:
        if self._ended.is_set():
            raise ProbeError(self._end)
        if rospy.is_shutdown():
            raise ProbeError("shut down")

    def _event(self, event: str, **values: Any) -> None:
        found = {"event": event, "time": rospy.get_time(), "wall": time.monotonic(), **values}
        self._events.write(json.dumps(found) + "\n")
        self._events.flush()


def run_probe(name: str, probe: type[SpeedProbe]) -> int:
    """Run a node that measures one flight, and return its exit status.

    Args:
        name: of the node.
        probe: what it measures.
    """
    init_plain_node(name)
    plan = json.loads(Path(rospy.get_param("~plan")).read_text(encoding="utf-8"))
    out = Path(rospy.get_param("~out"))
    with (out / "events.jsonl").open("w", encoding="utf-8") as events:
        return probe(plan, events).run()


if __name__ == "__main__":
    try:
        sys.exit(run_probe("formation_speed_meter", SpeedProbe))
    except rospy.ROSInterruptException:
        sys.exit(1)
