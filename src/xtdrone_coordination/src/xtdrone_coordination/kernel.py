"""``@kernel`` for the inner loops of this package; see ``kernel`` in ``xtdrone_control``."""

from __future__ import annotations

from pathlib import Path

from xtdrone_control import kernel as control_kernel

_PACKAGE = Path(__file__).resolve().parent

_CONTROL = Path(control_kernel.__file__).resolve().parent

kernel = control_kernel.compiler(
    _PACKAGE, _PACKAGE / "laws", _PACKAGE / "batch", _PACKAGE / "network", _CONTROL / "network"
)
