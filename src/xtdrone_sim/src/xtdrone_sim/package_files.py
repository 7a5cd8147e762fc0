"""Where the package's own files lie: beside the sources, or where an installed package has them."""

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
