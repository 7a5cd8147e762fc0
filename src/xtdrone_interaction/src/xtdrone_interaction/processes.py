"""A tree of processes that is gone when it is told to, whatever becomes of any of its members. Linux only.

roslaunch gives every node a session of its own, so neither a process group nor a session holds them all. Here this
process becomes the *subreaper*: whoever loses its parent becomes our child, so that every process that was started
below us can be found and ended. And the first child gets SIGTERM from the kernel when this process dies by whatever
cause.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36
_POLL = 0.05  # s
_STEPS = ((signal.SIGINT, 5.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 5.0))  # for what is left, s to wait after each

_libc = ctypes.CDLL(None, use_errno=True)


def _prctl(option: int, value: int) -> None:
    if _libc.prctl(option, value, 0, 0, 0) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"prctl({option}): {os.strerror(number)}")


class ProcessTree:
    """A program and everything that it starts.

    Attributes:
        process: the program itself.
    """

    def __init__(self, command: Sequence[str], env: Mapping[str, str], log: Path) -> None:
        """Start ``command`` in a session of its own; its output goes to ``log``. Call it from the main thread.

        Raises:
            OSError: it cannot be started.
        """
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        parent = os.getpid()

        def in_child() -> None:
            _prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
            if os.getppid() != parent:  # it died before the kernel knew
                os._exit(1)

        with log.open("wb") as output:
            self.process = subprocess.Popen(
                command,
                env=dict(env),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=in_child,
            )

    def wait(self, timeout: float) -> bool:
        """Wait up to ``timeout`` s and return whether the program has ended."""
        try:
            self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        return True

    def stop(self, patience: float) -> None:
        """End the program (SIGINT, after ``patience`` s SIGTERM, then SIGKILL), then whatever is left of its tree."""
        for number, limit in ((signal.SIGINT, patience), (signal.SIGTERM, 3.0), (signal.SIGKILL, 5.0)):
            if self.process.poll() is not None:
                break
            self.process.send_signal(number)
            self.wait(limit)
        end_descendants()


def descendants() -> list[int]:
    """Return the ids of all living processes below this one, zombies left out."""
    children: dict[int, list[int]] = {}
    zombies = set()
    for entry in os.listdir("/proc"):
        if not entry.isdigit():
            continue
        with contextlib.suppress(OSError):  # it ended meanwhile
            stat = Path(f"/proc/{entry}/stat").read_text(encoding="utf-8", errors="replace")
            state, parent = stat.rsplit(")", 1)[1].split()[:2]
            children.setdefault(int(parent), []).append(int(entry))
            if state in "ZX":
                zombies.add(int(entry))
    found: list[int] = []
    queue = [os.getpid()]
    while queue:
        below = children.get(queue.pop(), [])
        found += below
        queue += below
    return [pid for pid in found if pid not in zombies]


def end_descendants() -> None:
    """End every process below this one: SIGINT first, SIGKILL in the end."""
    for number, limit in _STEPS:
        for pid in descendants():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        end = time.monotonic() + limit
        while descendants() and time.monotonic() < end:
            _reap()
            time.sleep(_POLL)  # the kernel tells of our children only, not of theirs
        if not descendants():
            break
    _reap()


def _reap() -> None:
    """Collect the exit status of adopted children."""
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
