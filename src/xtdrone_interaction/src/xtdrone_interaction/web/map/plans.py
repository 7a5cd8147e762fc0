"""Plans drawn on the map: a region is divided among the selected vehicles, covered by lanes, and uploaded."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from xtdrone_autopilot.plans import qgc_plan
from xtdrone_autopilot.plans.qgc_plan import Plan
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.geodesy.projection import Datum
from xtdrone_common.settings import Settings, setting
from xtdrone_coordination.search.planning.coverage_path import lane_outlines
from xtdrone_coordination.search.planning.plans import SearchOptions, VehiclePlan, plan_search, to_plan
from xtdrone_coordination.search.planning.region import parse_region
from xtdrone_interaction.gcs import station
from xtdrone_interaction.gcs.exchanges import plans as plan_exchanges
from xtdrone_interaction.gcs.exchanges.exchange import Exchange, Heartbeat
from xtdrone_interaction.gcs.vehicle_addresses import GcsError
from xtdrone_interaction.web.commands.vehicle_commands import chosen_vehicles, peers_now
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch
from xtdrone_interaction.web.server.methods import CallError, Method, Params
from xtdrone_interaction.web.server.session import Session
from xtdrone_sim.vehicles.vehicle_model import load_vehicle

_PATIENCE = 10.0  # s of wall time without an answer
_MOST_PLANS = 20
_CAMERA = Pinhole.of_view(640, 360, 2.0)  # of a vehicle without one: the lanes are then those of the search's vehicle


@dataclass(frozen=True)
class DrawnPlan(Settings):
    """Options of a plan besides its region, set by the page."""

    height: float = setting(12.0, low=5.0, high=100.0, unit="m", text="height of the lowest vehicle over the ground")
    speed: float = setting(5.0, low=0.5, high=15.0, unit="m/s", text="speed over ground")
    overlap: float = setting(0.2, low=0.0, high=0.8, text="fraction of the footprint's width seen from both lanes")


class Plans:
    """Makes plans and uploads them by the ground station's exchange, as ``./xtdrone gcs upload``."""

    def __init__(self, context: StationContext, fleet: FleetWatch, datum: Callable[[], Datum | None]) -> None:
        """Start without plans; ``datum`` returns the origin of the map frame, None without a world."""
        self._context = context
        self._fleet = fleet
        self._datum = datum
        self._numbers = itertools.count(1)
        self._made: dict[int, dict[str, Plan]] = {}

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [
            Method("map.plan", self._plan),
            Method("map.upload", self._upload, "operate", recorded=self._recorded),
        ]

    async def _plan(self, _session: Session, params: Params) -> dict[str, Any]:
        """Return the number of a plan, the path of each vehicle, and the ground that its camera sees of each lane."""
        given = dict(params)
        names = chosen_vehicles(given.pop("vehicles", None), self._fleet.roster.vehicles)
        region = given.pop("region", None)
        drawn = DrawnPlan.from_mapping(given, "plan")
        homes = {name: self._home(name) for name in names}
        plans, files = await self._context.blocking(self._make, region, homes, drawn)
        number = next(self._numbers)
        self._made[number] = files
        for old in list(self._made)[:-_MOST_PLANS]:
            del self._made[old]
        ways = {name: [[w.x, w.y, made.height] for w in made.path] for name, made in plans.items()}
        seen = {name: [o.tolist() for o in lane_outlines(made.path, made.seen)] for name, made in plans.items()}
        return {"plan": number, "ways": ways, "seen": seen}

    def _make(
        self, region: object, homes: Mapping[str, tuple[float, float]], drawn: DrawnPlan
    ) -> tuple[dict[str, VehiclePlan], dict[str, Plan]]:
        datum = self._datum()
        if datum is None:
            raise CallError("plan: the running simulation has no world, and therefore no global origin")
        options = SearchOptions(height=drawn.height, speed=drawn.speed, overlap=drawn.overlap)
        plans = plan_search(parse_region(region), homes, self._camera(next(iter(homes))), options)
        files = {name: to_plan(made, options, datum) for name, made in plans.items()}
        too_long = [text for text in map(plan_exchanges.check_capacity, files.values()) if text]
        if too_long:
            raise CallError(f"plan: {too_long[0]}; a greater height or a smaller region needs less")
        return plans, files

    def _camera(self, name: str) -> Pinhole:
        model = next(vehicle.model for vehicle in self._fleet.roster.vehicles if vehicle.name == name)
        mounts = [mount for mount in load_vehicle(model).cameras if mount.kind == "rgb"]
        return mounts[0].pinhole if mounts else _CAMERA

    def _home(self, name: str) -> tuple[float, float]:
        models = self._fleet.models
        if models is None or name not in models.names:
            raise CallError(f"plan: the position of {name} is unknown")
        x, y = models.rows[models.names.index(name), :2].tolist()
        return x, y

    async def _upload(self, _session: Session, params: Params) -> dict[str, Any]:
        """Upload a plan made here, or ``files`` by vehicle; return for each vehicle whether it has stored its plan."""
        files = self._files(params)
        if files is None:
            raise CallError(f"plan: {str(params.get('plan'))[:40]!r} is not allowed, the number of a plan made here")
        results = await self._context.blocking(_send, files)
        return {
            name: {"ok": not isinstance(result, GcsError), "text": _text_of(result)} for name, result in results.items()
        }

    def _files(self, params: Params) -> Mapping[str, Plan] | None:
        given = params.get("files")
        if not isinstance(given, dict):
            plan = params.get("plan")
            return self._made.get(plan) if isinstance(plan, int) else None
        names = chosen_vehicles(list(given), self._fleet.roster.vehicles)
        return {name: qgc_plan.parse(str(given[name]), f"plan of {name}") for name in names}

    def _recorded(self, params: Params) -> Params:
        """Return the plans' texts in place of a number that only this station knows."""
        files = self._files(params)
        return params if files is None else {"files": {name: qgc_plan.text_of(plan) for name, plan in files.items()}}


def _text_of(result: Any) -> str:
    """Return the text on an upload's error or its alterations; "stored" for none."""
    if isinstance(result, GcsError):
        return str(result)
    return plan_exchanges.outcome(result) if result else "stored"


def _send(files: Mapping[str, Plan]) -> dict[str, Any]:
    def store(name: str, heartbeat: Heartbeat) -> Exchange[list[str]]:
        progress = station.progress_of(name, None)
        return plan_exchanges.upload_plan(heartbeat.system, files[name], progress)

    jobs = {peer: partial(store, peer.name) for peer in peers_now(list(files))}
    return dict(station.run(jobs, patience=_PATIENCE))
