"""The live window of a simulator's node: a process of its own, so that drawing never holds up the flight."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence

_PR_SET_PDEATHSIG = 1
_PATIENCE = 3.0  # s of wall time that the window gets to close
_libc = ctypes.CDLL(None)


def wanted(view: bool | None) -> bool:
    """Return whether a window is to be opened.

    Args:
        view: what the user has said; None: nothing, then there is one where there is a display.

    Raises:
        ValueError: it is asked for where there is no display.
    """
    has_display = bool(os.environ.get("DISPLAY"))
    if view and not has_display:
        raise ValueError("~view: there is no display (DISPLAY is not set); a film needs none, see visualize.py")
    return has_display if view is None else view


@contextlib.contextmanager
def live_window(kind: str, count: int, remappings: Sequence[str]) -> Iterator[None]:
    """Show ``visualize.py``'s window while the block runs; the user may close it before, which ends nothing else.

    Args:
        kind: vehicle type.
        count: how many.
        remappings: the node's own arguments of ROS; its name and parameters are not passed on.
    """
    passed = [text for text in remappings if ":=" in text and (text.startswith("__ns") or not text.startswith("_"))]
    command = [sys.executable, "-m", "xtdrone_swarm.view", kind, str(count), *passed]
    parent = os.getpid()

    def end_with_us() -> None:
        """Have the kernel end the window with this process, however that ends."""
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        if os.getppid() != parent:  # it ended before the kernel knew
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
