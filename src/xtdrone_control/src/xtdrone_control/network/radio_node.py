"""Topics between vehicles by radio: a vehicle's messages reach the others with a delay, or not at all.

For each vehicle ``T``, and each topic ``NAME`` of ``~topics``:

=================================  ===================  ===========================================================
topic                              type                 meaning
=================================  ===================  ===========================================================
/T/NAME                            as ``~topics`` says  in: messages that T broadcasts
/T/radio/NAME                      the same             out: messages from all others, in order of arrival
/T/mavros/local_position/pose      PoseStamped          in, with a finite range; or /xtdrone/swarm for all at once
/diagnostics                       DiagnosticArray      out: once a second
=================================  ===================  ===========================================================
"""

from __future__ import annotations

import heapq
import io
import itertools
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import roslib.message
import rospy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Float64MultiArray

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import ArgumentError, check_no_arguments, needed_fleet, run_program
from xtdrone_control.network.message_radio import MessageRadio
from xtdrone_control.network.network_options import NetworkOptions

RATE = 50.0  # Hz
USAGE = "radio.py   (parameters: ~topics, ~seed, ~range, ~delay, ~jitter, ~loss, ~burst, ~bandwidth, ~queue)"
_OVERHEAD_BITS = 8 * 28  # headers of UDP and IP
_REPORT_PERIOD = 1.0  # s
_FIELDS = 6  # numbers a vehicle in the swarm topic


class Radio:
    """Carries topics between the vehicles of a fleet."""

    def __init__(
        self, fleet: Sequence[str], topics: Mapping[str, type], radio: MessageRadio, *, needs_positions: bool
    ) -> None:
        """Declare the topics.

        Args:
            fleet: names of all vehicles.
            topics: types by name below the vehicles' names.
            radio: decides on arrivals.
            needs_positions: whether they depend on positions.
        """
        self._fleet, self._radio = fleet, radio
        self._positions = np.full((len(fleet), 3), np.nan)
        self._arrivals: list[tuple[float, int, int, str, Any]] = []  # a heap: time, order, receiver, topic, message
        self._order = itertools.count()
        self._delivered = 0
        self._reported = -np.inf
        self._outputs = [
            {topic: lockstep.Publisher(f"/{name}/radio/{topic}", kind) for topic, kind in topics.items()}
            for name in fleet
        ]
        self._diagnostics = lockstep.Publisher("/diagnostics", DiagnosticArray)
        if needs_positions:
            self._subscribe_positions()
        for i, name in enumerate(fleet):
            for topic, kind in topics.items():
                lockstep.Subscriber(f"/{name}/{topic}", kind, partial(self._on_message, i, topic))
        lockstep.add_reset_hook(self._restart)

    def _subscribe_positions(self) -> None:
        topic = str(rospy.get_param("/xtdrone/swarm_topic", ""))
        if topic:
            lockstep.Subscriber(topic, Float64MultiArray, self._on_swarm)
            return
        for i, name in enumerate(self._fleet):
            lockstep.Subscriber(f"/{name}/mavros/local_position/pose", PoseStamped, partial(self._on_pose, i))

    def step(self) -> None:
        """Deliver the messages that have arrived; call it at 50 Hz."""
        now = rospy.Time.now().to_sec()
        while self._arrivals and self._arrivals[0][0] <= now:
            _, _, receiver, topic, message = heapq.heappop(self._arrivals)
            self._outputs[receiver][topic].publish(message)
            self._delivered += 1
        if now - self._reported >= _REPORT_PERIOD:
            self._reported = now
            self._report()

    def _restart(self) -> None:
        self._radio.restart()
        self._arrivals.clear()
        self._order = itertools.count()
        self._positions[:] = np.nan
        self._delivered, self._reported = 0, -np.inf

    def _on_message(self, sender: int, topic: str, message: Any) -> None:
        buffer = io.BytesIO()
        message.serialize(buffer)
        bits = 8 * buffer.tell() + _OVERHEAD_BITS
        now = rospy.Time.now().to_sec()
        for time, receiver in self._radio.send(now, sender, bits, self._positions):
            heapq.heappush(self._arrivals, (time, next(self._order), receiver, topic, message))

    def _on_pose(self, index: int, message: PoseStamped) -> None:
        p = message.pose.position
        self._positions[index] = p.x, p.y, p.z

    def _on_swarm(self, message: Float64MultiArray) -> None:
        if len(message.data) == _FIELDS * len(self._fleet):
            self._positions[:] = np.array(message.data).reshape(-1, _FIELDS)[:, :3]

    def _report(self) -> None:
        radio = self._radio
        values = (
            ("Messages sent", radio.sent),
            ("Delivered", self._delivered),
            ("On their way", len(self._arrivals)),
            ("Lost", radio.lost),
            ("Out of range", radio.out_of_range),
        )
        status = DiagnosticStatus(
            DiagnosticStatus.OK, "radio", "carries messages", "", [KeyValue(key, str(value)) for key, value in values]
        )
        report = DiagnosticArray(status=[status])
        report.header.stamp = rospy.Time.now()
        self._diagnostics.publish(report)


def message_types(given: object) -> dict[str, type]:
    """Return the types that ``~topics`` names, as planner/trajectory:xtdrone_msgs/SplineTrajectory, comma-separated.

    Raises:
        ArgumentError: the text has another form, or a type is unknown.
    """
    if not isinstance(given, str) or not given.strip():
        raise ArgumentError(f"~topics: {given!r} is not allowed, TOPIC:PACKAGE/TYPE, comma-separated, at least one")
    kinds = {}
    for part in given.split(","):
        topic, _, name = part.strip().partition(":")
        kind = roslib.message.get_message_class(name) if name.count("/") == 1 else None
        if kind is None or not topic.strip("/"):
            raise ArgumentError(f"~topics: {part.strip()!r} is not allowed, TOPIC:PACKAGE/TYPE of a known type")
        kinds[topic.strip("/")] = kind
    return kinds


def run_radio() -> int:
    """Run the program with ``sys.argv``; return the exit status."""

    def main(arguments: Sequence[str]) -> None:
        check_no_arguments(arguments)
        fleet = [vehicle.name for vehicle in needed_fleet(rospy.get_param("/xtdrone/fleet", None))]
        lockstep.init_node("radio", rate=RATE)
        try:
            options = NetworkOptions.from_parameters(
                rospy.get_param, names=("range", "delay", "jitter", "loss", "burst", "bandwidth", "queue")
            )
            radio = MessageRadio(len(fleet), options, int(rospy.get_param("~seed", 0)))
        except ValueError as error:
            raise ArgumentError(str(error)) from error
        topics = message_types(rospy.get_param("~topics", None))
        with lockstep.registering_together():
            node = Radio(fleet, topics, radio, needs_positions=options.range < np.inf or options.bandwidth < np.inf)
        lockstep.start()
        lockstep.spin(node.step)

    return run_program(main, sys.argv, USAGE)
