"""``@kernel`` and its variants for the simulator's inner loops; see ``xtdrone_control.kernel_cache``.

Only ``kernel_that_allocates`` and ``kernel_that_allocates_for_threads`` can create and return arrays.
"""

from __future__ import annotations

from pathlib import Path

from xtdrone_control import kernel_cache

_packages = Path(__file__).resolve().parent, Path(kernel_cache.__file__).resolve().parent
kernel = kernel_cache.compiler(*_packages, allocates=False)
kernel_for_threads = kernel_cache.compiler(*_packages, nogil=True, allocates=False)
kernel_that_allocates = kernel_cache.compiler(*_packages)
kernel_that_allocates_for_threads = kernel_cache.compiler(*_packages, nogil=True)
