"""pybullet without its output on the terminal at import and at every connection."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Iterator, Sequence
from typing import Any

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


class SharingClient(BulletClient):  # type: ignore[misc]
    """A physics server in this process whose equal collision shapes are one.

    pybullet keeps the shapes of removed bodies until it is disconnected, and removeCollisionShape refuses those that a
    body has ever used: a model that is added and deleted again and again would take 4 to 30 kB each time.
    """

    def __init__(self) -> None:
        """Connect without a window."""
        super().__init__(pybullet.DIRECT)
        self._shapes: dict[str, int] = {}

    def createCollisionShape(self, kind: int, **values: Any) -> int:  # noqa: N802 (pybullet's name)
        """Return the number of a shape; see pybullet."""
        return self._shared("createCollisionShape", {"shapeType": kind, **values})

    def createCollisionShapeArray(self, **values: Any) -> int:  # noqa: N802
        """Return the number of a compound shape; see pybullet."""
        return self._shared("createCollisionShapeArray", values)

    def _shared(self, function: str, values: dict[str, Any]) -> int:
        files = [name for name in (values.get("fileName"), *values.get("fileNames", ())) if name]
        versions = [(status.st_mtime_ns, status.st_size) for status in map(os.stat, files)]
        key = repr((function, values, versions))
        if key not in self._shapes:
            self._shapes[key] = int(getattr(pybullet, function)(**values, physicsClientId=self._client))
        return self._shapes[key]


def connect() -> SharingClient:
    """Return a new physics server in this process, without a window."""
    with without_lines(_CHATTER):
        return SharingClient()
