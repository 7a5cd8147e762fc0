"""Worlds by name: files of the package, files of users, and worlds generated from a seed."""

from __future__ import annotations

from pathlib import Path

from xtdrone_sim.descriptions import ModelError
from xtdrone_sim.worlds.generated import KINDS, UPSTREAM, generated_file, is_generated
from xtdrone_sim.worlds.sdf import SdfWorld, load_world_file, world_file, world_names

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
