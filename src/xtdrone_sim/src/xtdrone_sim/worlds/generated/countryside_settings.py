"""Countryside: the scenery of ``outdoor``, with its options by name."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_control.settings import Settings, setting
from xtdrone_sim.worlds.people_meshes import names
from xtdrone_sim.worlds.scenery.countryside_layout import LIGHTS, outdoor
from xtdrone_sim.worlds.sdf import SdfWorld


@dataclass(frozen=True)
class CountrysideSettings(Settings):
    """Options of a countryside."""

    seed: int = setting(0, low=0, text="of all random choices")
    length: float = setting(100.0, low=30.0, high=1000.0, unit="m", text="along x, from -10 m on")
    width: float = setting(60.0, low=30.0, high=1000.0, unit="m", text="along y, from -10 m on")
    persons: int = setting(1, low=0, high=100, text="number of persons")
    walking: bool = setting(False, text="persons walk instead of standing")
    objects: float = setting(1.0, low=0.0, high=3.0, text="factor on the number of things")
    light: str = setting("noon", choices=LIGHTS, text="time of day and weather")


def countryside(settings: CountrysideSettings) -> SdfWorld:
    """Generate the countryside of a seed.

    Raises:
        ValueError: a person has no free place.
    """
    return outdoor(
        settings.seed,
        region=(-10.0, -10.0, settings.length - 10.0, settings.width - 10.0),
        persons=settings.persons,
        walking=settings.walking,
        skins=names(),
        objects=settings.objects,
        light=settings.light,
    )
