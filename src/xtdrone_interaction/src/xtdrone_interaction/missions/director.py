"""What all directors do: events on a topic and in a file, progress, the wait for the recorder, and the node itself."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import rospy
import yaml
from std_msgs.msg import String

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.programs.under_roslaunch import end_launch
from xtdrone_interaction.recording.flight_events import EVENTS_FILE, EventsFile
from xtdrone_interaction.recording.topics import EVENTS_TOPIC, PROGRESS_TOPIC

RECORDER_LIMIT = 30.0  # s of wall time


class FlightReporter:
    """Tells the events and the progress of a flight."""

    def __init__(self, folder: str = "") -> None:
        """Open the events file and declare the topics.

        Args:
            folder: Folder of events.jsonl; "" for none.

        Raises:
            OSError: the file cannot be written.
        """
        self._file: EventsFile | None = None
        if folder:
            path = Path(folder)
            path.mkdir(parents=True, exist_ok=True)
            self._file = EventsFile(path / EVENTS_FILE, lambda text: rospy.logerr("director: %s", text))
        self._events = lockstep.Publisher(EVENTS_TOPIC, String)
        self._progress = lockstep.Publisher(PROGRESS_TOPIC, String)

    def event(self, event: str, **values: Any) -> str:
        """Publish an event, append it to the file with the wall time (which no topic may contain), and return it."""
        told = {"event": event, "time": rospy.get_time(), **values}
        told = {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in told.items()}
        text = json.dumps(told)
        self._events.publish(String(text))
        if self._file is not None:
            self._file.write(json.dumps({**told, "wall": time.monotonic()}) + "\n")
        return text

    def progress(self, phase: str, step: int, steps: int, **values: Any) -> None:
        """Publish the progress of the flight: step ``step`` of ``steps``, called ``phase``."""
        told = {"sim_time": rospy.get_time(), "phase": phase, "step": step, "steps": steps, **values}
        self._progress.publish(String(json.dumps(told)))

    def wait_for_recorder(self, node: str) -> None:
        """Wait until a node has subscribed to the events, for a limited time; return at once for ''."""
        if node and not self._events.wait_for_subscriber(node, RECORDER_LIMIT):
            rospy.logerr(
                "director: %s has not subscribed within %g s: the flight may not be recorded", node, RECORDER_LIMIT
            )

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


class Director(Protocol):
    """Directs a flight."""

    recorder: str
    reporter: FlightReporter
    ends_launch: bool
    """Whether the launch also ends with a flight that has failed."""

    def run(self) -> int:
        """Fly, and return the exit status."""

    def close(self) -> None:
        """Release all files and services."""


def run_director(node: str, rate: float, make: Callable[[list[str]], Director]) -> int:
    """Run the node of a director, and return its exit status.

    Args:
        node: Name of the node.
        rate: Rate of the node, Hz.
        make: Makes the director of vehicles by their names, the first one the leader; may raise what a parameter
            causes: KeyError, ValueError, OSError, YAMLError.
    """
    try:
        return _run(node, rate, make)
    except rospy.ROSInitException as error:
        print(f"{node}: {error}", file=sys.stderr)
        return 1
    except rospy.ROSInterruptException:
        return 1


def _run(node: str, rate: float, make: Callable[[list[str]], Director]) -> int:
    lockstep.init_node(node, rate=rate)
    try:
        names = [vehicle.name for vehicle in parse_fleet(str(rospy.get_param("/xtdrone/fleet")))]
        with lockstep.registering_together():
            director = make(names)
    except KeyError as error:
        rospy.logfatal("%s: parameter %s is not set", node, error)
        return 1
    except OSError as error:
        rospy.logfatal("%s: out: %s: %s", node, error.filename, error.strerror)
        return 1
    except (ValueError, yaml.YAMLError) as error:
        rospy.logfatal("%s: %s", node, error)
        return 1
    director.reporter.wait_for_recorder(director.recorder)
    lockstep.start()
    try:
        status = director.run()
    finally:
        director.close()
    if status == 0 or director.ends_launch:
        end_launch()
    return status
