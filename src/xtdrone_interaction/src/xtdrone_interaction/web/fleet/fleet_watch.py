"""Track the vehicles' poses, and send the fleet's frame to the pages."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import rospy
from gazebo_msgs.msg import ModelStates
from numpy.typing import NDArray

from xtdrone_common.fleet import FleetError, parse_fleet
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_frame import CHANNEL, pack_fleet_frame
from xtdrone_interaction.web.fleet.model_states_bytes import ModelRows, TruncatedError, read_model_states
from xtdrone_interaction.web.fleet.roster import Roster
from xtdrone_interaction.web.server.methods import Method, Params
from xtdrone_interaction.web.server.session import Session
from xtdrone_sim.topics.model_states import TOPIC as LIVE_STATES

_OTHER_STATES = "/gazebo/model_states"  # without a simulator of this project, as when a bag is played
_CONNECT_LIMIT = 1.5  # s of wall time after which live states are searched for elsewhere
_FLEET_PERIOD = 2.0  # s between two queries of the fleet's parameter
log = logging.getLogger("xtdrone.web")


class FleetWatch:
    """Subscribes to the simulator's true states at a rate in wall time, while a page is open.

    Attributes:
        roster: the vehicles.
        models: newest states; None before the first.
        watchers: called with the vehicles' rows of each frame and its time, s, in the event loop.
    """

    def __init__(self, context: StationContext, rate: float) -> None:
        """Begin to watch.

        Args:
            context: of the station.
            rate: of the frame, Hz of wall time.
        """
        self.roster = Roster()
        self.models: ModelRows | None = None
        self.watchers: list[Callable[[NDArray[np.float64], float], None]] = []
        self._context = context
        self._packed: bytes | None = None
        self._number = 0
        self._told = -1
        self._subscribers: dict[str, rospy.Subscriber] = {}
        self._live_since = 0.0
        context.every(1.0 / rate, self._send)
        context.every(_FLEET_PERIOD, self._read_fleet)

    @property
    def names(self) -> list[str]:
        """Names of the vehicles, in the order of the rows."""
        return [vehicle.name for vehicle in self.roster.vehicles]

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [Method("fleet.roster", self._describe)]

    async def _read_fleet(self) -> None:
        self._listen(self._wanted())
        text = await self._context.blocking(rospy.get_param, "/xtdrone/fleet", None)
        try:
            self.roster.set_fleet(parse_fleet(str(text)) if text is not None else ())
        except FleetError as error:
            log.warning("parameter /xtdrone/fleet: %s; no vehicle is shown", error)

    def _describe(self, _session: Session, _params: Params) -> dict[str, Any]:
        return self.roster.describe(self.models)

    def _listen(self, topics: Collection[str]) -> None:
        """Subscribe to these topics and to no other."""
        for topic in self._subscribers.keys() - set(topics):
            self._subscribers.pop(topic).unregister()
        for topic in topics:
            if topic not in self._subscribers:
                self._subscribers[topic] = rospy.Subscriber(
                    topic, rospy.AnyMsg, self._on_states, queue_size=1, buff_size=1 << 20
                )

    def _wanted(self) -> tuple[str, ...]:
        """Return the topics of states that are needed now: none without pages."""
        if not self._context.sessions:
            return ()
        live = self._subscribers.get(LIVE_STATES)
        if live is None:
            self._live_since = time.monotonic()
        waits = time.monotonic() - self._live_since < _CONNECT_LIMIT
        return (LIVE_STATES,) if waits or live is None or live.get_num_connections() else (LIVE_STATES, _OTHER_STATES)

    def _on_states(self, message: rospy.AnyMsg) -> None:
        if message._connection_header.get("type") == ModelStates._type:
            self._packed = message._buff

    def _send(self) -> None:
        sessions = list(self._context.sessions.values())
        if bool(sessions) != bool(self._subscribers):
            self._listen(self._wanted())
        packed, self._packed = self._packed, None
        if packed is None:
            return
        try:
            self.models = read_model_states(packed, self.models)
        except TruncatedError as error:
            log.warning("states of the models: %s; they are left out", error)
            return
        vehicles, movers = self.roster.split(self.models)
        if self.roster.version != self._told:
            self._told = self.roster.version
            self._context.push_all("fleet.roster", self.roster.describe(self.models))
        self._number += 1
        now = rospy.get_time()
        for watch in self.watchers:
            watch(vehicles, now)
        frame = pack_fleet_frame(vehicles, movers, now, self.roster.version, self._number)
        for session in sessions:
            session.push_latest(CHANNEL, frame)
