"""``@kernel`` and ``@kernel_for_threads`` for the simulator's inner loops; see ``xtdrone_control.kernel``."""

from __future__ import annotations

from pathlib import Path

from xtdrone_control import kernel as control_kernel

_packages = Path(__file__).resolve().parent, Path(control_kernel.__file__).resolve().parent
kernel = control_kernel.compiler(*_packages)
kernel_for_threads = control_kernel.compiler(*_packages, nogil=True)
