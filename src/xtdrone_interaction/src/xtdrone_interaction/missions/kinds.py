"""The register of all kinds of flight."""

from __future__ import annotations

from pathlib import Path

from xtdrone_interaction.missions.any_flight import AnyFlight
from xtdrone_interaction.missions.crossing.report import CrossingMission
from xtdrone_interaction.missions.exploration.report import ExplorationMission
from xtdrone_interaction.missions.formation.report import FormationMission
from xtdrone_interaction.missions.landing.report import LandingMission
from xtdrone_interaction.missions.mission import Mission
from xtdrone_interaction.missions.search.report import SearchMission
from xtdrone_interaction.missions.slam.report import SlamMission

MISSIONS: tuple[Mission, ...] = (
    SearchMission(),
    ExplorationMission(),
    CrossingMission(),
    LandingMission(),
    SlamMission(),
    AnyFlight(),
    FormationMission(),
)
"""All kinds; the first one that recognises a recording reports it."""


def mission_of(file: Path) -> Mission:
    """Return the kind of a recorded flight."""
    return next((mission for mission in MISSIONS if mission.recognises(file)), AnyFlight())
