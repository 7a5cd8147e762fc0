"""Parts of MAVROS that this layer does not offer, and the detection of publishers whose messages would be lost.

``docs/mavros.md`` is generated from ``LEFT_OUT`` and from the plugins; a test fails if that lists an offered topic.
Names of plugins and topics are those of MAVROS 1.x (``mavros_plugins.xml`` of mavros and mavros_extras).

A daemon thread queries the master for topics without a subscriber periodically in wall time, so no topic needs a
subscription and the simulation is not affected. The larger the ROS graph, the longer the period.
"""

from __future__ import annotations

import difflib
import logging
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from xtdrone_common.fleet import COMMAND_TOPICS


@dataclass(frozen=True)
class LeftOut:
    """The part of a MAVROS plugin that is not offered.

    Attributes:
        why: the reason, as part of a sentence.
        instead: the replacement, empty for none.
        published: topics that MAVROS publishes, below the vehicle's ``mavros`` namespace unless they begin with "/".
        subscribed: topics that MAVROS subscribes to.
    """

    why: str
    instead: str = ""
    published: tuple[str, ...] = ()
    subscribed: tuple[str, ...] = ()


LEFT_OUT: dict[str, tuple[LeftOut, ...]] = {
    "global_position": (LeftOut("HOME_POSITION of the autopilot is used", subscribed=("home_position/home",)),),
    "guided_target": (
        LeftOut(
            "it serves ArduPilot's guided mode",
            "setpoint_raw/target_local",
            published=("/move_base_simple/goal",),
            subscribed=("global_position/gp_origin",),
        ),
    ),
    "rangefinder": (LeftOut("only ArduPilot sends it"),),
    "safety_area": (LeftOut("MAVROS's configuration for PX4 denies it", "geofence/push"),),
    "setpoint_position": (
        LeftOut("the autopilot's messages are used", subscribed=("global_position/global", "local_position/pose")),
    ),
    "wheel_odometry": (LeftOut("a simulated multicopter has no wheels"),),
    "mavros": (  # the node itself
        LeftOut("ground stations use their own ports, docs/ground-stations.md", published=("/mavlink/gcs_ip",)),
        LeftOut(
            "frame rotations are fixed and need no tf; setpoint plugins use tf with tf/listen",
            published=("/tf_static",),
            subscribed=("/tf", "/tf_static"),
        ),
    ),
}


def plugin_reasons() -> dict[str, str]:
    """Return the reasons by MAVROS plugin, for plugins that are not offered in full."""
    return {plugin: "; ".join(entry.why for entry in entries) for plugin, entries in LEFT_OUT.items()}


def topics_left_out() -> dict[str, LeftOut]:
    """Return the topics that only MAVROS subscribes to, without the namespace, with their entries."""
    return {topic: entry for entries in LEFT_OUT.values() for entry in entries for topic in entry.subscribed}


def explain(entry: LeftOut) -> str:
    """Return the reason and the replacement as the end of a sentence."""
    return f"{entry.why}; use {entry.instead}" if entry.instead else entry.why


log = logging.getLogger("rosout.mavros")

PERIOD = 5.0  # s of wall time between checks, at least
_SHARE = 200.0  # a check may take at most 1/200 of the time
_LIKENESS = 0.85

Registrations = Mapping[str, Collection[str]]  # topic to the names of nodes


class UnheardTopic(NamedTuple):
    """A topic without a subscriber, a node that publishes on it, and the text of the warning."""

    topic: str
    node: str
    text: str


class GraphWatch:
    """Periodic check of the ROS graph; warns once for each topic."""

    def __init__(
        self,
        own_name: str,
        prefixes: Collection[str],
        left_out: Mapping[str, LeftOut],
        system_state: Callable[[], tuple[Registrations, Registrations]],
        vehicles: Collection[str] = (),
    ) -> None:
        """Prepare the check.

        Args:
            own_name: this node's name.
            prefixes: namespaces of the vehicles' topics, e.g. ``/iris_0/mavros``.
            left_out: topics below the prefixes that MAVROS subscribes to and this node does not.
            system_state: returns publishers and subscribers by topic; may raise OSError.
            vehicles: names, e.g. ``iris_0``, whose XTDrone commands are checked, too.
        """
        self._own_name = own_name
        self._prefixes = frozenset(prefixes)
        self._left_out = left_out
        self._system_state = system_state
        self._commands = {f"/xtdrone/{name}/{topic}": name for name in vehicles for topic in COMMAND_TOPICS}
        self._told: set[str] = set()
        self._ending = threading.Event()

    def start(self) -> None:
        """Start the checks in a daemon thread."""
        threading.Thread(target=self._run, name="mavros watch", daemon=True).start()

    def stop(self) -> None:
        """Stop the checks."""
        self._ending.set()

    def check(self) -> None:
        """Check once, and warn about new findings.

        Raises:
            OSError: the master does not answer.
        """
        for finding in self.findings(*self._system_state()):
            if finding.topic not in self._told:
                self._told.add(finding.topic)
                log.warning("%s, on which %s publishes, %s", *finding)

    def findings(self, publishers: Registrations, subscribers: Registrations) -> Iterator[UnheardTopic]:
        """Yield the topics without a subscriber in a state of the graph."""
        for topic, nodes in sorted(publishers.items()):
            others = sorted(set(nodes) - {self._own_name, *self._idle_relays(topic, publishers, subscribers)})
            if not others or self._own_name in nodes or self._own_name in subscribers.get(topic, ()):
                continue
            text = self._words(topic, subscribers)
            if text:
                yield UnheardTopic(topic, others[0], text)

    def _idle_relays(self, topic: str, publishers: Registrations, subscribers: Registrations) -> Collection[str]:
        """Return the nodes that publish a command only if it is sent to the leader, while no node sends it."""
        source = f"/xtdrone/leader/{topic.rpartition('/')[2]}"
        return subscribers.get(source, ()) if topic in self._commands and not publishers.get(source) else ()

    def _words(self, topic: str, subscribers: Registrations) -> str:
        if topic in self._commands:
            return "" if subscribers.get(topic) else _without_communication(self._commands[topic])
        prefix = self._prefix(topic)
        if prefix is None:
            return self._without_vehicle(topic, subscribers)
        name = topic[len(prefix) + 1 :]
        entry = self._left_out.get(name)
        if entry is not None:
            return f"is not supported here: {explain(entry)}"
        if subscribers.get(topic):
            return ""
        own = [known for known, nodes in subscribers.items() if self._own_name in nodes and known.startswith(prefix)]
        alike = difflib.get_close_matches(topic, own, 1, _LIKENESS)
        if alike:
            return f"has no subscriber; is {alike[0]} meant?"
        return "has no subscriber: no loaded plugin subscribes to it; plugin_denylist may exclude its plugin"

    def _without_vehicle(self, topic: str, subscribers: Registrations) -> str:
        """Return the warning for a topic below ``/mavros`` when the vehicles have namespaces."""
        head, _, name = topic[1:].partition("/")
        if head != "mavros" or self._own_name in self._prefixes or subscribers.get(topic) or not name:
            return ""
        prefix = min(self._prefixes)
        return f"belongs to no vehicle and has no subscriber; the vehicles' topics are {prefix}/{name} and so on"

    def _prefix(self, topic: str) -> str | None:
        end = topic.find("/", 1)
        while end > 0:
            if topic[:end] in self._prefixes:
                return topic[:end]
            end = topic.find("/", end + 1)
        return None

    def _run(self) -> None:
        pause = PERIOD
        while not self._ending.wait(pause):
            begin = time.monotonic()
            try:
                self.check()
            except OSError as error:
                log.debug("the master does not list publishers: %s", error)
            pause = max(PERIOD, _SHARE * (time.monotonic() - begin))


def _without_communication(vehicle: str) -> str:
    kind, _, index = vehicle.rpartition("_")
    start = f"rosrun xtdrone_control multirotor_communication.py {kind} {index}"
    return f"has no subscriber: XTDrone's commands need the vehicle's communication node: {start}"
