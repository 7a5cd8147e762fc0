#!/usr/bin/env python3
"""Node that measures how fast the cooperative search is simulated, once all vehicles search.

A plain rospy node outside the lockstep. It needs no clock: the mission control publishes the simulated time once per
simulated second.

================================  ==============================  ================================================
subscribed
/xtdrone/search/progress          std_msgs/String                 JSON with ``sim_time``, ``phase``, ``vehicles``
/xtdrone/T/objects                xtdrone_msgs/ObjectsOnGround    one for each image processed by the detector
================================  ==============================  ================================================

Parameters:
    /xtdrone/fleet (as ``typhoon_h480:6``): the vehicles.
    ~window (s, above 0): simulated time of the measurement, once all vehicles search.
    ~out: folder for events.jsonl.

events.jsonl has the formation director's format: one JSON object per line with ``event``, ``time`` (simulated s) and
``wall`` (epoch s). ``start`` is the first, followed by a ``progress`` (``phase``) for each message of the mission
control, then ``window`` (see :meth:`SearchProbe.run`) and ``done``, or ``failed`` (``reason``).

Exit status: 0 after a measurement, 1 after a failed one, 2 for bad parameters.
"""

from __future__ import annotations

import json
import math
import os
import queue
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import rospy
from std_msgs.msg import String
from xtdrone_msgs.msg import ObjectsOnGround

from benchmarks.process_use import CpuSample, memory, process_tree
from xtdrone_common.fleet import FleetError, parse_fleet
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_interaction.recording.topics import SEARCH_PROGRESS_TOPIC

_SEARCHES = {"searching", "second look", "back to its lane"}  # states of a searching vehicle
_OVER = {"returning", "finished"}  # phases
_SLICE = 0.2  # s of wall time between checks for a shutdown


class ProbeError(RuntimeError):
    """The search cannot be measured; the message gives the reason."""


@dataclass(frozen=True)
class Progress:
    """A message of the mission control.

    Attributes:
        time: simulated, s.
        wall: time of arrival, s, monotonic clock.
        phase: of the search.
        states: of the vehicles, by name.
    """

    time: float
    wall: float
    phase: str
    states: dict[str, str]

    @classmethod
    def read(cls, text: str, wall: float) -> Progress:
        """Return the content of a message received at ``wall``."""
        said = json.loads(text)
        return cls(said["sim_time"], wall, said["phase"], said["vehicles"])


class Pictures:
    """Counters of processed and skipped images; each vehicle is counted by its own subscriber thread."""

    def __init__(self, names: Iterable[str]) -> None:
        """Set the counters of the vehicles ``names`` to 0."""
        self._counts = dict.fromkeys(names, (0, 0))

    def count(self, name: str, dropped: int) -> None:
        """Count a processed image of a vehicle; ``dropped`` of its images have been skipped so far."""
        self._counts[name] = (self._counts[name][0] + 1, dropped)

    def counted(self) -> tuple[int, int]:
        """Return the number of images processed and skipped so far."""
        counts = self._counts.values()
        return sum(seen for seen, _ in counts), sum(dropped for _, dropped in counts)


class SearchProbe:
    """Measurement of one search, written as events."""

    def __init__(self, window: float, pictures: Pictures, events: TextIO) -> None:
        """Prepare the measurement.

        Args:
            window: minimum length of the measurement, simulated s.
            pictures: counters, updated during the measurement.
            events: receives the events as JSON lines.
        """
        self._window = window
        self._pictures = pictures
        self._events = events
        self._time = 0.0

    def run(self, messages: Iterable[Progress]) -> int:
        """Measure and return the exit status of the program: 0, or 1 if it failed.

        The event ``window`` has ``simulated`` and ``elapsed`` (s of simulated and of wall time), ``pictures`` and
        ``dropped`` (of all cameras: processed and skipped), ``cpu`` (CPU s by program), ``others`` (CPU s
        that other programs used or that the hypervisor took), ``memory`` (bytes) and ``processes``, of everything that
        the launch file started.

        Args:
            messages: of the mission control, until the launch ends.
        """
        self._event("start")
        try:
            self._measure(self._reported(messages))
        except ProbeError as error:
            self._event("failed", reason=str(error))
            return 1
        self._event("done")
        return 0

    def _reported(self, messages: Iterable[Progress]) -> Iterator[Progress]:
        """Yield the messages, and report each as an event.

        Raises:
            ProbeError: the search is over, or there are no more messages.
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
        before, (seen, dropped) = CpuSample.take(root), self._pictures.counted()
        last = next(message for message in messages if message.time - first.time >= self._window)
        cpu, (all_seen, all_dropped) = CpuSample.take(root).since(before), self._pictures.counted()
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
        self._events.write(json.dumps({"event": event, "time": self._time, "wall": time.monotonic(), **values}) + "\n")
        self._events.flush()


def main() -> int:
    """Run the node and return its exit status."""
    init_plain_node("search_speed_meter", disable_rostime=True)
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
    rospy.Subscriber(
        SEARCH_PROGRESS_TOPIC, String, lambda message: messages.put(Progress.read(message.data, time.perf_counter()))
    )
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


if __name__ == "__main__":
    try:
        sys.exit(main())
    except rospy.ROSInterruptException:
        sys.exit(1)
    except rospy.ROSInitException as error:
        sys.exit(f"search_speed_meter: {error}")
