"""XTDrone's commands to the leader and to vehicles, and formations: by name, by image, or drawn."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rospy
from numpy.typing import NDArray
from std_msgs.msg import String

from xtdrone_coordination.patterns import PatternError, Patterns
from xtdrone_interaction.topics.connected_publishers import ConnectedPublishers
from xtdrone_interaction.web.commands.vehicle_commands import chosen_vehicles
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch
from xtdrone_interaction.web.server.methods import CallError, Method, Params, needed
from xtdrone_interaction.web.server.session import Session

_TEXT = re.compile(r"[ -~]{1,200}")
_FAR = 500.0  # m between two slots
_NEAR = 0.5  # m, minimum distance of two drawn slots
LEADER = "leader"


class SwarmCommands:
    """Sends commands on ``/xtdrone/leader/cmd`` and ``/xtdrone/VEHICLE/cmd``."""

    def __init__(self, context: StationContext, fleet: FleetWatch) -> None:
        self._context = context
        self._fleet = fleet
        self._topics = ConnectedPublishers(context.master)
        self._drawn = itertools.count(1)

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [
            Method("swarm.patterns", self._patterns),
            Method("swarm.command", self._command, "operate"),
            Method("swarm.draw", self._draw, "operate"),
        ]

    async def _patterns(self, _session: Session, _params: Params) -> list[dict[str, Any]]:
        """Return name and slots (m ENU from the leader) of each pattern for this number of vehicles."""
        count = self._count()
        return await self._context.blocking(_described, count) if count >= 2 else []

    async def _command(self, _session: Session, params: Params) -> str:
        """Send a text to ``leader``, or to the named vehicles."""
        text = needed(params, "text", str, "1 to 200 printable characters of ASCII, as HOVER")
        if not _TEXT.fullmatch(text):
            raise CallError(f"text: {text[:80]!r} is not allowed, 1 to 200 printable characters of ASCII, as HOVER")
        if params.get("target") == LEADER:
            names = [LEADER]
        else:
            names = chosen_vehicles(params.get("vehicles"), self._fleet.roster.vehicles)
        await self._context.blocking(self._send, names, text)
        return f"{text}: sent to {', '.join(names[:6])}{' ...' if len(names) > 6 else ''}"

    def _send(self, names: Sequence[str], text: str) -> None:
        for name in names:
            topic = f"/xtdrone/{name}/cmd"
            if not self._topics.publish(topic, String(text)):
                raise CallError(f"topic: no node subscribes to {topic}; ./xtdrone doctor names what is missing")

    async def _draw(self, _session: Session, params: Params) -> str:
        """Fly the pattern that a page has drawn: a slot for each follower, m ENU from the leader."""
        slots = checked_slots(params.get("slots"), self._count() - 1)
        return await self._context.blocking(self._fly_drawn, slots)

    def _fly_drawn(self, slots: NDArray[np.float64]) -> str:
        folder = str(rospy.get_param("/leader/cloud_folder", ""))
        if not folder or not Path(folder).is_dir():
            raise CallError(
                f"drawn pattern: the leader's cloud_folder {folder!r} is no folder; launch with cloud_folder:=DIR"
            )
        name = f"drawn_{next(self._drawn)}.xyz"
        points = np.vstack([np.zeros(3), slots])
        np.savetxt(Path(folder) / name, points, fmt="%.3f")
        self._send([LEADER], f"cloud:{Path(folder) / name}")
        return f"{name}: sent to the leader"

    def _count(self) -> int:
        """Return the number of vehicles of the leader's type, the first one of the fleet."""
        vehicles = self._fleet.roster.vehicles
        return sum(vehicle.type == vehicles[0].type for vehicle in vehicles) if vehicles else 0


def checked_slots(slots: object, count: int) -> NDArray[np.float64]:
    """Return drawn slots, shape (count, 3), m.

    Raises:
        CallError: wrong number, not finite, too far, or too near to each other or to the leader.
    """
    try:
        array = np.asarray(slots, float)
    except (TypeError, ValueError) as error:
        raise CallError(f"slots: {str(slots)[:80]} is not allowed, {count} times x, y, z in m") from error
    if array.shape != (count, 3) or not np.all(np.abs(array) <= _FAR):
        raise CallError(f"slots: shape {array.shape} is not allowed, {count} times x, y, z within {_FAR:g} m")
    points = np.vstack([np.zeros(3), array])
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2) + np.diag(np.full(len(points), np.inf))
    if gaps.min() < _NEAR:
        raise CallError(f"slots: {gaps.min():.2f} m between two is not allowed, at least {_NEAR} m")
    return array


def _described(count: int) -> list[dict[str, Any]]:
    patterns = Patterns(count, below="")
    described = []
    for name in patterns.names:
        try:
            described.append({"name": name, "slots": np.round(patterns.offsets(name), 2).tolist()})
        except PatternError:
            continue  # not for this number
    return described
