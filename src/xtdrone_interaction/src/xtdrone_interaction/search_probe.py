"""The node that measures how fast the cooperative search is simulated, once all vehicles search.

A plain rospy node that takes no part in the lockstep, and needs no clock: the mission control tells the simulated time
once a second of it.

================================  ==============================  ================================================
subscribed
/xtdrone/search/progress          std_msgs/String                 JSON with ``sim_time``, ``phase``, ``vehicles``
/xtdrone/T/objects                xtdrone_msgs/ObjectsOnGround    one for each picture that the detector looked at
================================  ==============================  ================================================

It writes events.jsonl as the formation director does: one JSON object a line with ``event``, ``time`` (simulated s) and
``wall`` (epoch s). ``start`` is the first, then there is a ``progress`` (``phase``) for each of the mission control's,
then ``window`` (see :meth:`SearchProbe.run`) and ``done``, or ``failed`` (``reason``).
"""

from __future__ import annotations

import json
import math
import os
import queue
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import rospy
from std_msgs.msg import String
from xtdrone_msgs.msg import ObjectsOnGround

from xtdrone_control.fleet import FleetError, parse_fleet
from xtdrone_interaction.bench_processes import CpuSample, memory, process_tree
from xtdrone_interaction.search_record import PROGRESS_TOPIC

_SEARCHES = {"searching", "second look", "back to its lane"}  # states of a vehicle that is at it
_OVER = {"returning", "finished"}  # phases
_SLICE = 0.2  # s of wall time between two looks at a shutdown


class ProbeError(RuntimeError):
    """The search cannot be measured; the message says why."""


@dataclass(frozen=True)
class Progress:
    """A message of the mission control.

    Attributes:
        time: simulated, s.
        wall: when it came, s of a clock that never goes back.
        phase: of the search.
        states: of the vehicles, by name.
    """

    time: float
    wall: float
    phase: str
    states: dict[str, str]

    @classmethod
    def read(cls, text: str, wall: float) -> Progress:
        """Return what a message says that came at ``wall``."""
        said = json.loads(text)
        return cls(said["sim_time"], wall, said["phase"], said["vehicles"])


class Pictures:
    """What the detector has done with the pictures so far; each vehicle's are counted by a thread of its own."""

    def __init__(self, names: Iterable[str]) -> None:
        """No picture has come yet of the vehicles ``names``."""
        self._counts = dict.fromkeys(names, (0, 0))

    def count(self, name: str, dropped: int) -> None:
        """Count a picture of a vehicle; ``dropped`` of its pictures have been passed over so far."""
        self._counts[name] = (self._counts[name][0] + 1, dropped)

    def taken(self) -> tuple[int, int]:
        """Return how many were looked at, and passed over, by now."""
        counts = self._counts.values()
        return sum(seen for seen, _ in counts), sum(dropped for _, dropped in counts)


class SearchProbe:
    """Measures and writes events."""

    def __init__(self, window: float, pictures: Pictures, events: TextIO) -> None:
        """Measure nothing yet.

        Args:
            window: how long is measured at least, simulated s.
            pictures: counted meanwhile.
            events: gets the events as JSON lines.
        """
        self._window = window
        self._pictures = pictures
        self._events = events
        self._time = 0.0

    def run(self, messages: Iterable[Progress]) -> int:
        """Measure, and return the program's exit status: 0, or 1 when it failed.

        The event ``window`` has ``simulated`` and ``elapsed`` (s of simulated and of wall time), ``pictures`` and
        ``dropped`` (of all cameras together: looked at, passed over), ``cpu`` (CPU s by program), ``others`` (CPU s
        that other programs used or that the hypervisor took), ``memory`` (bytes) and ``processes``, of everything that
        the launch file started.

        Args:
            messages: the mission control's, as they come, until the launch ends.
        """
        self._event("start")
        try:
            self._measure(self._told(messages))
        except ProbeError as error:
            self._event("failed", reason=str(error))
            return 1
        self._event("done")
        return 0

    def _told(self, messages: Iterable[Progress]) -> Iterator[Progress]:
        """Pass messages on, and tell of them.

        Raises:
            ProbeError: they say that the search is over, or end.
        """
        for message in messages:
            self._time = message.time
            self._event("progress", phase=message.phase)
            if message.phase in _OVER:
                states = ", ".join(f"{name} {state}" for name, state in message.states.items())
                raise ProbeError(f"search: {message.phase} before {self._window:g} s were measured; {states}")
            yield message
        raise ProbeError(f"search: the launch ended before {self._window:g} s were measured")

    def _measure(self, messages: Iterator[Progress]) -> None:
        root = os.getppid()  # roslaunch
        first = next(message for message in messages if _SEARCHES.issuperset(message.states.values()))
        before, (seen, dropped) = CpuSample.take(root), self._pictures.taken()
        last = next(message for message in messages if message.time - first.time >= self._window)
        cpu, (all_seen, all_dropped) = CpuSample.take(root).since(before), self._pictures.taken()
        pids = process_tree(root)
        self._event(
            "window",
            simulated=last.time - first.time,
            elapsed=last.wall - first.wall,
            pictures=all_seen - seen,
            dropped=all_dropped - dropped,
            cpu=cpu.programs,
            others=cpu.others,
            memory=memory(pids),
            processes=len(pids),
        )

    def _event(self, event: str, **values: Any) -> None:
        self._events.write(json.dumps({"event": event, "time": self._time, "wall": time.time(), **values}) + "\n")
        self._events.flush()


def main() -> int:
    """Measure and return the exit status."""
    rospy.init_node("search_probe", disable_rostime=True)
    try:
        names = [vehicle.name for vehicle in parse_fleet(str(rospy.get_param("/xtdrone/fleet")))]
        window, out = float(rospy.get_param("~window")), Path(rospy.get_param("~out"))
    except KeyError as error:
        rospy.logfatal("search probe: parameter %s is not set", error)
        return 2
    except (FleetError, TypeError, ValueError) as error:
        rospy.logfatal("search probe: %s", error)
        return 2
    if not 0.0 < window < math.inf:
        rospy.logfatal("search probe: ~window: %r is not allowed, a number above 0", window)
        return 2
    pictures = Pictures(names)
    messages: queue.SimpleQueue[Progress] = queue.SimpleQueue()
    for name in names:
        rospy.Subscriber(f"/xtdrone/{name}/objects", ObjectsOnGround, partial(_on_objects, pictures, name))
    rospy.Subscriber(PROGRESS_TOPIC, String, lambda said: messages.put(Progress.read(said.data, time.perf_counter())))
    with (out / "events.jsonl").open("w", encoding="utf-8") as events:
        return SearchProbe(window, pictures, events).run(_until_shutdown(messages))


def _on_objects(pictures: Pictures, name: str, message: Any) -> None:
    pictures.count(name, message.dropped)


def _until_shutdown(messages: queue.SimpleQueue[Progress]) -> Iterator[Progress]:
    while not rospy.is_shutdown():
        try:
            yield messages.get(timeout=_SLICE)
        except queue.Empty:
            continue
