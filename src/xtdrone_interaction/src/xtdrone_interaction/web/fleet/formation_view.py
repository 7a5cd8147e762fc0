"""Slots and topology of the formation, for the page."""

from __future__ import annotations

from typing import Any

import numpy as np
import rospy
from std_msgs.msg import Float32MultiArray, Int32MultiArray

from xtdrone_interaction.recording.distances import offsets_from_message
from xtdrone_interaction.recording.topics import PATTERN_TOPIC, TOPOLOGY_TOPIC
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.server.methods import Method, Params
from xtdrone_interaction.web.server.session import Session

_MOST_LINKS = 20_000


class FormationView:
    """Keeps the latched pattern and topology of the leader, and passes changes on."""

    def __init__(self, context: StationContext) -> None:
        self._context = context
        self._state: dict[str, Any] = {"offsets": [], "links": []}
        rospy.Subscriber(PATTERN_TOPIC, Float32MultiArray, self._on_pattern, queue_size=1)
        rospy.Subscriber(TOPOLOGY_TOPIC, Int32MultiArray, self._on_topology, queue_size=1)

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [Method("fleet.formation", self._describe)]

    def _describe(self, _session: Session, _params: Params) -> dict[str, Any]:
        return self._state

    def _on_pattern(self, message: Float32MultiArray) -> None:
        self._change("offsets", offsets_from_message(message.data).tolist())

    def _on_topology(self, message: Int32MultiArray) -> None:
        count = int(len(message.data) ** 0.5)
        matrix = np.asarray(message.data[: count * count]).reshape(count, count)
        self._change("links", np.argwhere(matrix)[:_MOST_LINKS, ::-1].tolist())

    def _change(self, part: str, value: list[list[float]]) -> None:
        """Store offsets from the leader (m ENU), or links [from, to] as numbers of vehicles; notify the pages."""
        if value == self._state[part]:
            return
        self._state = {**self._state, part: value}
        self._context.in_loop(self._context.push_all, "fleet.formation", self._state)
