"""pybullet without what it writes on the terminal when it is imported, and at every connection."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Iterator, Sequence

_CHATTER = (b"pybullet build time:", b"argv[0]=")


@contextlib.contextmanager
def without_lines(beginnings: Sequence[bytes]) -> Iterator[None]:
    """Keep lines that begin so from stdout and stderr, those of compiled code too; all else comes a moment later."""
    with contextlib.ExitStack() as stack:
        for number in (1, 2):
            stack.enter_context(_filtered(number, tuple(beginnings)))
        yield


@contextlib.contextmanager
def _filtered(number: int, beginnings: tuple[bytes, ...]) -> Iterator[None]:
    """Do the same for one file descriptor; nothing where it is closed."""
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
    """Write out what compiled code has printed so far."""
    ctypes.CDLL(None).fflush(None)


with without_lines(_CHATTER):
    import pybullet
    from pybullet_utils.bullet_client import BulletClient


def connect() -> BulletClient:
    """Return a new physics server in this process, without a window."""
    with without_lines(_CHATTER):
        return BulletClient(pybullet.DIRECT)
