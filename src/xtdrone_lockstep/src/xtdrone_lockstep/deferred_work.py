"""Background work whose results become available at a fixed simulation time.

A node in lockstep submits long work (rendering an image, running a network) to a thread or process together with the
simulation time at which it is due, and continues with its turns. In the first turn at or after that time the node
collects the result, and waits for it only then if necessary. A slow machine thus runs more slowly, but with the same
result.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, NamedTuple


class Done(NamedTuple):
    """Completed work: its key and the return value of its function."""

    key: Any
    result: Any


class _Work(NamedTuple):
    due_us: int
    number: int
    key: Any
    future: Future[Any]


class Deferred:
    """Submitted work; used in the node's own thread only."""

    def __init__(self, workers: int = 1, *, executor: Executor | None = None, wait: bool = True) -> None:
        """Create the workers.

        Args:
            workers: Number of threads, at least 1; their work should release Python's global lock most of the time.
            executor: Executor to use instead of these threads (a ProcessPoolExecutor, say); closed with this object.
            wait: Whether ``ready`` waits for work that is due, as a node in lockstep must. A node on a real vehicle,
                whose turns must not be delayed, leaves it until it is complete.

        Raises:
            ValueError: The number of workers is not positive.
        """
        self._executor = executor or ThreadPoolExecutor(workers, thread_name_prefix="deferred")
        self._wait = wait
        self._work: list[_Work] = []
        self._number = 0

    def __len__(self) -> int:
        """Return the number of submitted items that have not been collected."""
        return len(self._work)

    def put(self, key: Any, due_us: int, function: Callable[..., Any], *arguments: Any) -> None:
        """Submit work.

        Args:
            key: Identifies the result; not interpreted.
            due_us: Simulation time in microseconds from which the result is available.
            function: Called with ``arguments`` by a worker.
            arguments: Must not be changed until the work is complete.
        """
        self._number += 1
        self._work.append(_Work(due_us, self._number, key, self._executor.submit(function, *arguments)))

    def ready(self, now_us: int) -> list[Done]:
        """Remove and return the results that are due, by due time, then in order of submission.

        Args:
            now_us: Simulation time in microseconds.

        Raises:
            Exception: An exception raised by a function.
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
        """Discard all work, as after a reset of simulation time; work that has been started runs to its end."""
        for work in self._work:
            work.future.cancel()
        self._work.clear()

    def close(self) -> None:
        """Discard all work and end the workers."""
        self.clear()
        self._executor.shutdown(cancel_futures=True)
