"""The station's rooms, each of which gives the methods that a page may call."""

from __future__ import annotations

from xtdrone_interaction.web.commands.swarm_commands import SwarmCommands
from xtdrone_interaction.web.commands.time_control import TimeControl
from xtdrone_interaction.web.commands.vehicle_commands import VehicleCommands
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch
from xtdrone_interaction.web.fleet.formation_view import FormationView
from xtdrone_interaction.web.fleet.vehicle_status import VehicleStatus
from xtdrone_interaction.web.fleet.world_view import WorldView
from xtdrone_interaction.web.map.plans import Plans
from xtdrone_interaction.web.map.search_view import SearchView
from xtdrone_interaction.web.server.methods import Method
from xtdrone_interaction.web.station_settings import StationSettings
from xtdrone_interaction.web.tool_rooms import tool_methods


def methods_of_rooms(context: StationContext, settings: StationSettings) -> list[Method]:
    """Open all rooms and return their methods."""
    fleet = FleetWatch(context, settings.rate)
    VehicleStatus(context, fleet)
    world = WorldView(context, fleet)
    return [
        *fleet.methods(),
        *world.methods(),
        *FormationView(context).methods(),
        *VehicleCommands(context, fleet).methods(),
        *SwarmCommands(context, fleet).methods(),
        *TimeControl(context, fleet).methods(),
        *SearchView(context, fleet, world.datum).methods(),
        *Plans(context, fleet, world.datum).methods(),
        *tool_methods(context, settings, fleet),
    ]
