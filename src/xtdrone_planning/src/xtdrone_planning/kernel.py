"""``@kernel`` for the inner loops of this package; see ``kernel`` in ``xtdrone_control``."""

from __future__ import annotations

from pathlib import Path

from xtdrone_control import kernel as control_kernel

kernel = control_kernel.compiler(Path(__file__).resolve().parent, Path(control_kernel.__file__).resolve().parent)
