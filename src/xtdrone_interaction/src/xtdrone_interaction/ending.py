"""The end of a server's process after a signal, also where one of its threads hangs.

rospy's shutdown and the interpreter's exit wait for locks and threads. A thread that waits for a ROS master without an
answer would hold them without end, and with them the process and its port.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

LIMIT = 5.0
"""Wall time that a server has for its shutdown after a signal, s."""


def end_within_limit(name: str, limit: float = LIMIT) -> None:
    """Let the process end with status 1 where its shutdown takes longer than a limit after SIGINT or SIGTERM.

    Call it in the main thread, after the handlers of these signals have been installed, which are called as before.

    Args:
        name: of the node, for the message.
        limit: wall time, s.
    """

    def end() -> None:
        os.write(
            sys.stderr.fileno(), f"{name}: the shutdown takes longer than {limit:g} s, the process ends\n".encode()
        )
        os._exit(1)

    for number in (signal.SIGINT, signal.SIGTERM):
        _precede(number, limit, end)


def _precede(number: signal.Signals, limit: float, end: Callable[[], None]) -> None:
    former = signal.getsignal(number)

    def handle(received: int, frame: FrameType | None) -> None:
        timer = threading.Timer(limit, end)
        timer.daemon = True
        timer.start()
        if callable(former):
            former(received, frame)

    signal.signal(number, handle)
