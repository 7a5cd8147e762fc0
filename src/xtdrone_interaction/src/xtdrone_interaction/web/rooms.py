"""The station's rooms, each of which gives the methods that a page may call."""

from __future__ import annotations

from xtdrone_interaction import options
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch
from xtdrone_interaction.web.inspection.all_rooms import inspection_methods
from xtdrone_interaction.web.recordings.recording_room import RecordingRoom
from xtdrone_interaction.web.server.methods import Method
from xtdrone_interaction.web.station_settings import StationSettings
from xtdrone_interaction.web.steering.steering_room import SteeringRoom

RECORDINGS = "runs"


def methods_of_rooms(context: StationContext, settings: StationSettings) -> list[Method]:
    """Open all rooms and return their methods."""
    fleet = FleetWatch(context, settings.rate)
    recordings = RecordingRoom(context, options.repository() / RECORDINGS)
    return [*fleet.methods(), *inspection_methods(context), *recordings.methods(), *SteeringRoom(context).methods()]
