"""``@kernel`` for the inner loops of this package; see ``xtdrone_common.kernel_cache``."""

from __future__ import annotations

from pathlib import Path

import xtdrone_control
from xtdrone_common import kernel_cache

_PACKAGE = Path(__file__).resolve().parent

_CONTROL = Path(xtdrone_control.__file__).resolve().parent

kernel = kernel_cache.compiler(
    _PACKAGE, _PACKAGE / "laws", _PACKAGE / "batch", _PACKAGE / "network", _CONTROL / "network"
)
