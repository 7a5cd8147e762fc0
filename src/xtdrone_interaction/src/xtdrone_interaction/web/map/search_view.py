"""A running search and the vehicles' missions, for the map."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from typing import Any

import rospy
from mavros_msgs.msg import WaypointList
from std_msgs.msg import String

from xtdrone_autopilot.navigator import plan
from xtdrone_common.geodesy.projection import Datum
from xtdrone_coordination.search.planning.region import RegionError, read_region, region_data
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch
from xtdrone_interaction.web.server.methods import Method, Params
from xtdrone_interaction.web.server.session import Session

_REGION = "/search_mission/region"
_MOST_EVENTS = 200
_PERIOD = 1.0  # s
_PLACES = (plan.TAKEOFF, plan.WAYPOINT, plan.LAND)  # items that have a place on the ground
_MOST_LONELY = 1e-7  # degrees; an item at 0, 0 has no place


class SearchView:
    """Keeps the search's region, progress and events, and the missions that MAVROS has read from the vehicles.

    Subscriptions to the missions of all vehicles are much of a page's cost: they are made only for pages with a map.
    """

    def __init__(self, context: StationContext, fleet: FleetWatch, datum: Callable[[], Datum | None]) -> None:
        """Subscribe.

        Args:
            context: of the station.
            fleet: the vehicles.
            datum: returns the origin of the map frame; None without a world.
        """
        self._context = context
        self._fleet = fleet
        self._datum = datum
        self._state: dict[str, Any] = {"region": None, "progress": None, "events": [], "trouble": ""}
        self._region_file = ""
        self._lists: dict[str, WaypointList] = {}
        self._subscribers: dict[str, Any] = {}
        self._pages: set[int] = set()  # that have asked for missions
        rospy.Subscriber("/xtdrone/search/event", String, self._on_event, queue_size=100)
        rospy.Subscriber("/xtdrone/search/progress", String, self._on_progress, queue_size=1)
        context.every(_PERIOD, self._follow_fleet)

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [Method("map.search", self._search), Method("map.missions", self._missions)]

    async def _search(self, _session: Session, _params: Params) -> dict[str, Any]:
        """Return region, progress and events (each None or empty without a search)."""
        await self._context.blocking(self._read_region)
        return self._state

    async def _missions(self, session: Session, _params: Params) -> dict[str, list[list[float]]]:
        """Return the path of each vehicle's mission, x, y (m ENU) and height (m); later changes are pushed."""
        self._pages.add(session.number)
        datum = await self._context.blocking(self._datum)
        return {name: way_of(items, datum) for name, items in self._lists.items()} if datum else {}

    def _read_region(self) -> None:
        file = str(rospy.get_param(_REGION, ""))
        if not file or file == self._region_file:
            return
        self._region_file = file
        try:
            self._state = {**self._state, "region": region_data(read_region(file)), "trouble": ""}
        except RegionError as error:
            self._state = {**self._state, "trouble": str(error)}

    async def _follow_fleet(self) -> None:
        self._pages &= self._context.sessions.keys()
        names = self._fleet.names if self._pages else []
        if names != list(self._subscribers):
            await self._context.blocking(self._subscribe, names)

    def _subscribe(self, names: list[str]) -> None:
        for subscriber in self._subscribers.values():
            subscriber.unregister()
        self._lists = {name: items for name, items in self._lists.items() if name in names}
        self._subscribers = {
            name: rospy.Subscriber(
                f"/{name}/mavros/mission/waypoints", WaypointList, partial(self._on_waypoints, name), queue_size=1
            )
            for name in names
        }

    def _on_waypoints(self, name: str, message: WaypointList) -> None:
        self._lists[name] = message
        self._context.in_loop(self._context.push_all, "map.missions", {"vehicle": name})

    def _on_event(self, message: String) -> None:
        event = _object(message.data)
        if event is not None:
            self._state = {**self._state, "events": [*self._state["events"], event][-_MOST_EVENTS:]}
            self._context.in_loop(self._context.push_all, "map.search", self._state)

    def _on_progress(self, message: String) -> None:
        progress = _object(message.data)
        if progress is not None:
            self._state = {**self._state, "progress": progress}
            self._context.in_loop(self._context.push_all, "map.search", self._state)


def way_of(message: WaypointList, datum: Datum) -> list[list[float]]:
    """Return the places of a mission's items, x, y (m ENU) and height over home, m."""
    items = [w for w in message.waypoints if w.command in _PLACES and abs(w.x_lat) + abs(w.y_long) > _MOST_LONELY]
    return [[*datum.local(item.x_lat, item.y_long), item.z_alt] for item in items]


def _object(text: str) -> dict[str, Any] | None:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None
