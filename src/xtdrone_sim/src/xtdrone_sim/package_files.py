"""Locations of the package's files: beside the sources, or in an installed package."""

from __future__ import annotations

from pathlib import Path


def _package() -> Path:
    source = Path(__file__).resolve().parents[2]
    if (source / "config").is_dir():
        return source
    import rospkg  # only an installed package needs it

    return Path(rospkg.RosPack().get_path("xtdrone_sim"))


PACKAGE = _package()
CONFIG = PACKAGE / "config"
MODELS = PACKAGE / "models"
