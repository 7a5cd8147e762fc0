"""``@kernel`` for the inner loops of this package; see ``xtdrone_common.kernel_cache``."""

from __future__ import annotations

from pathlib import Path

from xtdrone_common.kernel_cache import compiler

kernel = compiler(Path(__file__).resolve().parent, allocates=False)
