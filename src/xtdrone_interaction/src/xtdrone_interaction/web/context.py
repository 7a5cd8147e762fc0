"""Context shared by the rooms of the station: the ROS master, the pages, and threads for calls that block."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

from tornado.ioloop import IOLoop, PeriodicCallback

from xtdrone_interaction.web.server.methods import Method, Params, invoke
from xtdrone_interaction.web.server.session import Session, encode

_THREADS = 8
Result = TypeVar("Result")


@dataclass
class StationContext:
    """Given to each room; made in the event loop's thread.

    Attributes:
        master: URI of the ROS master.
        sessions: the connected pages by number; changed by the server.
        act: carries out a call of the role ``operate``.
        name: of the station's node, as ``/web_station``.
    """

    master: str
    name: str
    sessions: dict[int, Session] = field(default_factory=dict)
    act: Callable[[Method, Session, Params], Awaitable[Any]] = invoke
    _pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(_THREADS, "web"))
    _timers: list[PeriodicCallback] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._loop = IOLoop.current()

    async def blocking(self, call: Callable[..., Result], *arguments: Any, **named: Any) -> Result:
        """Run a function that blocks, such as a ROS service's call, in a thread, and return its result."""
        return await asyncio.get_running_loop().run_in_executor(self._pool, partial(call, *arguments, **named))

    def every(self, seconds: float, call: Callable[[], Any]) -> None:
        """Call a function, or a coroutine function, in the event loop periodically; calls never overlap."""
        timer = PeriodicCallback(call, 1000.0 * seconds)
        timer.start()
        self._timers.append(timer)

    def in_loop(self, call: Callable[..., Any], *arguments: Any) -> None:
        """Call a function in the event loop; from any thread."""
        self._loop.add_callback(call, *arguments)

    def push_all(self, event: str, data: Any) -> None:
        """Send an event to all pages; in the event loop."""
        if not self.sessions:
            return
        text = encode({"event": event, "data": data})
        for session in list(self.sessions.values()):
            session.push_text(text)

    def close(self) -> None:
        """End timers and threads."""
        for timer in self._timers:
            timer.stop()
        self._pool.shutdown(wait=False, cancel_futures=True)
