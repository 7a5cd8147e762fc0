"""``@kernel`` and its variants for the simulator's inner loops; see ``xtdrone_control.kernel``.

Only ``kernel_that_allocates`` and ``kernel_that_allocates_for_threads`` can create and return arrays.
"""

from __future__ import annotations

from pathlib import Path

from xtdrone_control import kernel as control_kernel

_packages = Path(__file__).resolve().parent, Path(control_kernel.__file__).resolve().parent
kernel = control_kernel.compiler(*_packages, allocates=False)
kernel_for_threads = control_kernel.compiler(*_packages, nogil=True, allocates=False)
kernel_that_allocates = control_kernel.compiler(*_packages)
kernel_that_allocates_for_threads = control_kernel.compiler(*_packages, nogil=True)
