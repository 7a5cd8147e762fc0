"""Log handler for a standard output that may be a file on a full disk, where rospy's own handler raises errors."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable

from rosgraph.roslogging import RosStreamHandler


def survive_full_disk() -> None:
    """Drop log lines that cannot be written to standard output; call it after ``rospy.init_node``."""
    for name in ("", "rosout"):
        for handler in logging.getLogger(name or None).handlers:
            if isinstance(handler, RosStreamHandler):
                handler.emit = _guarded(handler.emit)  # type: ignore[method-assign]


def _guarded(emit: Callable[[logging.LogRecord], None]) -> Callable[[logging.LogRecord], None]:
    def guarded(record: logging.LogRecord) -> None:
        with contextlib.suppress(OSError):
            emit(record)

    return guarded
