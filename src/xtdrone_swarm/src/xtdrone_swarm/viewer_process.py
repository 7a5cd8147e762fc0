"""The live window of a simulator node: a separate process, so that drawing never delays the flight."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence

_PR_SET_PDEATHSIG = 1
_PATIENCE = 3.0  # s of wall time for the window to close
_libc = ctypes.CDLL(None)


def wanted(view: bool | None) -> bool:
    """Return whether to open a live window.

    Args:
        view: the user's choice; None: open a window if a display is available.

    Raises:
        ValueError: a window is requested without a display.
    """
    has_display = bool(os.environ.get("DISPLAY"))
    if view and not has_display:
        raise ValueError("~view: there is no display (DISPLAY is not set); a film needs none, see visualize.py")
    return has_display if view is None else view


@contextlib.contextmanager
def live_window(kind: str, count: int, remappings: Sequence[str]) -> Iterator[None]:
    """Show ``visualize.py``'s window while the block runs; closing it earlier ends nothing else.

    Args:
        kind: vehicle type.
        count: number of vehicles.
        remappings: ROS arguments of the node; all but its name and parameters are passed on.
    """
    passed = [text for text in remappings if ":=" in text and (text.startswith("__ns") or not text.startswith("_"))]
    command = [sys.executable, "-m", "xtdrone_swarm.view", kind, str(count), *passed]
    parent = os.getpid()

    def end_with_us() -> None:
        """Make the operating system end the window when this process ends for any reason."""
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        if os.getppid() != parent:  # the parent ended before prctl took effect
            os._exit(1)

    window = subprocess.Popen(command, stdin=subprocess.DEVNULL, preexec_fn=end_with_us)
    try:
        yield
    finally:
        window.terminate()
        try:
            window.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            window.kill()
            window.wait()
