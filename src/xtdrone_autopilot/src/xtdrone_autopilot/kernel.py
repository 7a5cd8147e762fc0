"""``@kernel`` for the inner loops of this package; see ``xtdrone_common.kernel_cache``."""

from __future__ import annotations

from pathlib import Path

from xtdrone_common import kernel_cache

_packages = Path(__file__).resolve().parent, Path(kernel_cache.__file__).resolve().parent
kernel = kernel_cache.compiler(*_packages, allocates=False)
