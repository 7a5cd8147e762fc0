"""pybullet without its output on the terminal at import and at every connection."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Iterator, Sequence

_CHATTER = (b"pybullet build time:", b"argv[0]=")


@contextlib.contextmanager
def without_lines(beginnings: Sequence[bytes]) -> Iterator[None]:
    """Remove lines that start with ``beginnings`` from stdout and stderr, including those of compiled code.

    All other lines are delayed until the block ends.
    """
    with contextlib.ExitStack() as stack:
        for number in (1, 2):
            stack.enter_context(_filtered(number, tuple(beginnings)))
        yield


@contextlib.contextmanager
def _filtered(number: int, beginnings: tuple[bytes, ...]) -> Iterator[None]:
    """Filter one file descriptor; do nothing if it is closed."""
    _flush()
    try:
        terminal = os.dup(number)
    except OSError:
        yield
        return
    with open(os.memfd_create("output"), "w+b", buffering=0) as kept:
        os.dup2(kept.fileno(), number)
        try:
            yield
        finally:
            _flush()
            os.dup2(terminal, number)
            os.close(terminal)
            kept.seek(0)
            rest = [line for line in kept.readall().splitlines(keepends=True) if not line.startswith(beginnings)]
            if rest:
                os.write(number, b"".join(rest))


def _flush() -> None:
    """Flush the output buffers of compiled code."""
    ctypes.CDLL(None).fflush(None)


with without_lines(_CHATTER):
    import pybullet
    from pybullet_utils.bullet_client import BulletClient


def connect() -> BulletClient:
    """Return a new physics server in this process, without a window."""
    with without_lines(_CHATTER):
        return BulletClient(pybullet.DIRECT)
