"""``@kernel`` and its variants for the simulator's inner loops; see ``xtdrone_common.kernel_cache``.

Only ``kernel_that_allocates`` and ``kernel_that_allocates_for_threads`` can create and return arrays.
"""

from __future__ import annotations

from pathlib import Path

import xtdrone_autopilot
import xtdrone_worlds
from xtdrone_common import kernel_cache

_others = (kernel_cache, xtdrone_autopilot, xtdrone_worlds)
_packages = Path(__file__).resolve().parent, *(Path(str(other.__file__)).resolve().parent for other in _others)
kernel = kernel_cache.compiler(*_packages, allocates=False)
kernel_for_threads = kernel_cache.compiler(*_packages, nogil=True, allocates=False)
kernel_that_allocates = kernel_cache.compiler(*_packages)
kernel_that_allocates_for_threads = kernel_cache.compiler(*_packages, nogil=True)
