"""Worlds by name: files of the package, files of users, and worlds generated from a seed.

``forest:seed=3,density=0.05`` names a kind of generated worlds, ``forest``, ``maze``, ``indoor``, ``city`` or
``countryside``, and its options. ``UPSTREAM`` has worlds of similar purpose and dimensions under the names of XTDrone's
worlds.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_common.files import ContentError, load_yaml
from xtdrone_common.settings import SettingError, Settings
from xtdrone_worlds.data_files import cached_folder
from xtdrone_worlds.descriptions import ModelError
from xtdrone_worlds.worlds.generated.city import CitySettings, city
from xtdrone_worlds.worlds.generated.forest import ForestSettings, forest
from xtdrone_worlds.worlds.generated.indoor import IndoorSettings, indoor
from xtdrone_worlds.worlds.generated.maze import MazeSettings, maze
from xtdrone_worlds.worlds.scenery.countryside_layout import CountrysideSettings, countryside
from xtdrone_worlds.worlds.sdf import SdfWorld, load_world_file, world_file, world_names, write_world

_MOST_TEXT = 1000


@dataclass(frozen=True)
class Kind:
    """A kind of generated world: its options and its generator."""

    settings: type[Settings]
    generate: Callable[[Any], SdfWorld]


KINDS = {
    "forest": Kind(ForestSettings, forest),
    "maze": Kind(MazeSettings, maze),
    "indoor": Kind(IndoorSettings, indoor),
    "city": Kind(CitySettings, city),
    "countryside": Kind(CountrysideSettings, countryside),
}

# Dimensions of the walls and grounds in sitl_config/worlds of XTDrone.
UPSTREAM = {
    "indoor1": "indoor:length=20,width=10,room=5,corridor=2,ceiling=false,seed=1",  # a cafe
    "indoor2": "indoor:length=21,width=14,room=4,corridor=1.6,height=2.5,ceiling=true,seed=2",  # a house
    "indoor3": "indoor:length=24,width=15,room=3.5,corridor=1.8,height=2.5,furniture=0,ceiling=true,seed=3",
    "indoor4": "indoor:length=68,width=52,room=7,corridor=2.5,height=2.5,furniture=0,ceiling=true,seed=4",
    "indoor5": "maze:columns=24,rows=17,cell=15,height=5,wall=0.5,loops=0.15,seed=5",  # a playground of walls
    "outdoor1": "city:columns=10,rows=10,block=40,street=10,height=30,seed=1",
    "outdoor2": "countryside:objects=0,length=500,width=100,persons=0,seed=2",  # an airfield
    "outdoor3": "countryside:length=300,width=150,objects=0.3,persons=0,seed=3",  # roads among hills
    "outdoor4": "city:columns=6,rows=5,block=40,street=10,height=9,trees=8,seed=4",  # a small town
    "ego_swarm": "maze:columns=4,rows=4,cell=4.85,height=2.5,wall=0.15,loops=0.6,seed=6",
}


def is_generated(name: str) -> bool:
    """Return whether a world's name is that of a kind, with or without options, or one of ``UPSTREAM``."""
    return name in UPSTREAM or name.partition(":")[0] in KINDS


def generate(name: str) -> SdfWorld:
    """Generate a world; equal names give equal worlds.

    Args:
        name: ``KIND``, ``KIND:OPTION=VALUE,OPTION=VALUE``, or a name of ``UPSTREAM``.

    Raises:
        ModelError: an unknown kind or option, or a value that is not allowed.
    """
    kind, _, text = UPSTREAM.get(name, name).partition(":")
    if kind not in KINDS:
        raise ModelError(f"worlds: {kind[:60]!r} cannot be generated; there are {', '.join(KINDS)}")
    try:
        settings = KINDS[kind].settings.from_mapping(_options(kind, text), f"world {kind}")
        return KINDS[kind].generate(settings)
    except (SettingError, ValueError) as error:
        raise ModelError(str(error)) from error


def _options(kind: str, text: str) -> dict[str, object]:
    options: dict[str, object] = {}
    for part in text[:_MOST_TEXT].split(",") if text else []:
        name, equals, value = (one.strip() for one in part.partition("="))
        if not equals or name in options:
            raise ModelError(f"world {kind}: {part[:60]!r} is not allowed, OPTION=VALUE, each option once")
        try:
            options[name] = load_yaml(value)
        except ContentError as error:
            raise ModelError(f"world {kind}: {name}: {value[:60]!r} is not a value") from error
    return options


def generated_file(name: str) -> Path:
    """Return the SDF file of a generated world, in the user's cache.

    Raises:
        ModelError: see ``generate``; or the file cannot be written.
    """
    text = write_world(generate(name))
    kind = name.partition(":")[0]
    folder = f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"

    def write(target: Path) -> None:
        (target / f"{kind}.world").write_text(text, encoding="utf-8")

    try:
        return cached_folder("worlds", folder, write) / f"{kind}.world"
    except OSError as error:
        raise ModelError(f"world {name}: its file cannot be written: {error}") from error


_ENDINGS = (".world", ".sdf", ".yaml", ".yml")


def known_names() -> list[str]:
    """Return the names of all worlds without options."""
    return sorted({*world_names(), *KINDS, *UPSTREAM})


def is_known(name: str) -> bool:
    """Return whether a world has this name, options included."""
    return name in world_names() or is_generated(name)


def find_world(name: str) -> Path:
    """Return the absolute path of a world's file; that of a generated world is written first.

    Args:
        name: a name of ``known_names``, a generated one with options, or a path; see ``sdf.load_world_file``.

    Raises:
        ModelError: an unknown name, or an option that is not allowed.
    """
    if is_generated(name):
        return generated_file(name)
    if not name.endswith(_ENDINGS) and name not in world_names():
        raise ModelError(f"worlds: {name[:80]!r} is not known; there are {', '.join(known_names())}")
    return world_file(name)


def load_world(name: str) -> SdfWorld:
    """Load a world; see ``find_world``.

    Raises:
        ModelError: an unknown name, an option that is not allowed, or an invalid file.
    """
    return load_world_file(str(find_world(name)))
