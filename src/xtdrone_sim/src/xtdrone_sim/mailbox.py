"""Queue of requests from other threads to the simulator's thread, which alone may access the simulation."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

Request = Callable[["Future[Any]"], None]
"""Called in the simulator's thread; it sets the result (or an exception) of the future, immediately or later."""


class ClosedError(RuntimeError):
    """The simulator's thread accepts no more requests."""


class Mailbox:
    """A queue that wakes the simulator's thread."""

    def __init__(self) -> None:
        """Create an empty queue."""
        self._queue: queue.SimpleQueue[tuple[Request, Future[Any]]] = queue.SimpleQueue()
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._lock = threading.Lock()  # serialises ``put`` and ``close``
        self._closed = False

    def fileno(self) -> int:
        """Return a descriptor that is readable while requests are queued."""
        return self._event

    def put(self, request: Request) -> Future[Any]:
        """Queue a request; called from any thread.

        Returns:
            The future of its answer; it holds a ClosedError if the mailbox is closed.
        """
        answer: Future[Any] = Future()
        with self._lock:
            if self._closed:
                answer.set_exception(ClosedError("the simulator shuts down"))
                return answer
            self._queue.put((request, answer))
            os.eventfd_write(self._event, 1)
        return answer

    def serve(self) -> None:
        """Execute the queued requests; called from the simulator's thread."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._event)
        while True:
            try:
                request, answer = self._queue.get_nowait()
            except queue.Empty:
                return
            try:
                request(answer)
            except Exception as error:  # raised again in the waiting caller
                if answer.done():
                    raise
                answer.set_exception(error)

    def close(self) -> None:
        """Reject further requests; queued ones receive a ClosedError."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            os.close(self._event)
        while True:
            try:
                _, answer = self._queue.get_nowait()
            except queue.Empty:
                return
            answer.set_exception(ClosedError("the simulator shuts down"))
