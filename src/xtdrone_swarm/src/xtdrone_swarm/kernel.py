"""``@kernel`` for the simplified simulator's inner loops; see ``xtdrone_control.kernel``."""

from __future__ import annotations

from pathlib import Path

from xtdrone_control import kernel as control_kernel

kernel = control_kernel.compiler(Path(__file__).resolve().parents[1])
