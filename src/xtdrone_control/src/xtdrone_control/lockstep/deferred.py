"""Work that goes on beside a node's turns and whose results count from a fixed simulated time on.

A node that takes part in the lockstep hands long work (drawing a picture, running a network) to a thread or process,
says when in simulated time it is due, and goes on with its turns: flight goes on meanwhile. At the turn at or after the
due time the node takes the result, and only then waits for it if it is not there yet. So a slow machine runs slower,
never differently.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, NamedTuple


class Done(NamedTuple):
    """Work that is done: the key it was given, and what its function returned."""

    key: Any
    result: Any


class _Work(NamedTuple):
    due_us: int
    number: int
    key: Any
    future: Future[Any]


class Deferred:
    """Work under way, for the node's own thread."""

    def __init__(self, workers: int = 1, *, executor: Executor | None = None, wait: bool = True) -> None:
        """Start with none.

        Args:
            workers: threads, at least 1; what they run should release Python's lock for most of its time.
            executor: what runs the work in place of these threads (a ProcessPoolExecutor, say); closed with this.
            wait: True to wait for what is due: a node in lockstep. False to leave it until it is done: a node on a
                real vehicle, whose turns must go on.

        Raises:
            ValueError: the number of workers is not positive.
        """
        self._executor = executor or ThreadPoolExecutor(workers, thread_name_prefix="deferred")
        self._wait = wait
        self._work: list[_Work] = []
        self._number = 0

    def __len__(self) -> int:
        """Return how much has been put and not been taken."""
        return len(self._work)

    def put(self, key: Any, due_us: int, function: Callable[..., Any], *arguments: Any) -> None:
        """Begin work.

        Args:
            key: what the result is known by; nothing is done with it.
            due_us: simulated time from which on the result counts, microseconds.
            function: called with ``arguments`` by a worker.
            arguments: no other thread may change them meanwhile.
        """
        self._number += 1
        self._work.append(_Work(due_us, self._number, key, self._executor.submit(function, *arguments)))

    def ready(self, now_us: int) -> list[Done]:
        """Return what is due, and forget it: by due time, then in the order in which it was put.

        Args:
            now_us: simulated time, microseconds.

        Raises:
            Exception: what a function raised.
        """
        taken = []
        for work in sorted(self._work, key=lambda work: work[:2]):
            if work.due_us > now_us:
                break
            if not self._wait and not work.future.done():
                continue
            self._work.remove(work)
            taken.append(Done(work.key, work.future.result()))
        return taken

    def clear(self) -> None:
        """Forget everything, as when the time is set back; what a worker has begun it ends."""
        for work in self._work:
            work.future.cancel()
        self._work.clear()

    def close(self) -> None:
        """Forget everything and end the workers."""
        self.clear()
        self._executor.shutdown(cancel_futures=True)
